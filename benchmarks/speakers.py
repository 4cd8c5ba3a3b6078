"""Who publishes what on the topics of a stage: an observer that takes the publisher of each message from DDS.

rclpy gives a callback no more than numbers of a message. ``rcl_take_serialized_message`` also gives the identifier of
its publisher, by which the graph names the node.
"""

import ctypes
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.type_support import check_for_type_support
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

TOPICS = {"voltage_command": Float64MultiArray, "stage_state": JointState}
# Whatever reliability is offered; the reader keeps what comes while this process waits for its processor.
HEARD = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)
POLL = 0.005
UNKNOWN = "_UNKNOWN_"


class _Bytes(ctypes.Structure):
    """rcl_serialized_message_t."""

    _fields_ = (
        ("buffer", ctypes.c_void_p), ("length", ctypes.c_size_t), ("capacity", ctypes.c_size_t),
        ("allocator", ctypes.c_void_p * 5),
    )  # fmt: skip


class _Info(ctypes.Structure):
    """rmw_message_info_t of Jazzy."""

    _fields_ = (
        ("source_timestamp", ctypes.c_int64), ("received_timestamp", ctypes.c_int64),
        ("publication_sequence_number", ctypes.c_uint64), ("reception_sequence_number", ctypes.c_uint64),
        ("implementation", ctypes.c_char_p), ("gid", ctypes.c_uint8 * 16), ("from_intra_process", ctypes.c_bool),
    )  # fmt: skip


def _loaded(name: str) -> ctypes.CDLL:
    """Return a library that rclpy has loaded."""
    lines = Path("/proc/self/maps").read_text().splitlines()
    return ctypes.CDLL(next(line.split()[5] for line in lines if f"/{name}" in line))


class _Allocator(ctypes.Structure):
    """rcl_allocator_t."""

    _fields_ = (("words", ctypes.c_void_p * 5),)


@dataclass(frozen=True)
class Said:
    """One message: when it was sent (s, by the clock of the system), by whom on which topic, and its voltages (V)."""

    at: float
    name: str
    topic: str
    voltages: tuple[float, ...]


class Speakers:
    """All voltages and states in a namespace, each with the name of its node, from `begin` to `close`."""

    def __init__(self, namespace: str) -> None:
        self.said: list[Said] = []
        self._names: dict[bytes, str] = {}
        self._context = Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node("observer", context=self._context, namespace=namespace)
        self._take = _loaded("librcl.so").rcl_take_serialized_message
        self._take.argtypes = [ctypes.c_void_p, ctypes.POINTER(_Bytes), ctypes.POINTER(_Info), ctypes.c_void_p]
        utils = _loaded("librcutils.so")
        utils.rcutils_get_default_allocator.restype = _Allocator
        self._data = _Bytes(allocator=utils.rcutils_get_default_allocator().words)
        self._readers: dict[str, Any] = {}
        for topic, kind in TOPICS.items():
            check_for_type_support(kind)
            full = self.node.resolve_topic_name(topic)
            with self.node.handle:
                self._readers[full] = rclpy_implementation.Subscription(
                    self.node.handle, kind, full, HEARD.get_c_qos_profile()
                )
        self.node.create_timer(POLL, self._poll)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._ended, self._thread = threading.Event(), threading.Thread(target=self._spin)

    def begin(self) -> None:
        """Listen from now on, and serve what else `node` was given."""
        self._executor.add_node(self.node)
        self._thread.start()

    def close(self) -> None:
        """Listen no more."""
        self._ended.set()
        self._thread.join()
        self._executor.shutdown()
        for reader in self._readers.values():
            reader.destroy_when_not_in_use()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _spin(self) -> None:
        while not self._ended.is_set():
            self._executor.spin_once(timeout_sec=0.1)

    def _poll(self) -> None:
        for topic, reader in self._readers.items():
            with reader:
                while (taken := self._next(reader)) is not None:
                    self._keep(topic, *taken)

    def _next(self, reader: Any) -> tuple[float, bytes, bytes] | None:
        """Return when the next message was sent (s), the message, and the identifier of its publisher."""
        info = _Info()
        if self._take(reader.pointer, self._data, info, None):
            return None
        return info.source_timestamp * 1e-9, ctypes.string_at(self._data.buffer, self._data.length), bytes(info.gid)

    def _keep(self, topic: str, sent: float, data: bytes, gid: bytes) -> None:
        kind = topic.rpartition("/")[2]
        message: Any = deserialize_message(data, TOPICS[kind])
        voltages = message.data if kind == "voltage_command" else message.effort
        self.said.append(Said(sent, self._name(topic, gid), kind, tuple(voltages)))

    def _name(self, topic: str, gid: bytes) -> str:
        """Return the name of a node; its publisher may be known before it."""
        for _ in range(100):
            if gid in self._names:
                break
            for each in self.node.get_publishers_info_by_topic(topic):
                if each.node_name and UNKNOWN not in each.node_name:
                    self._names[bytes(each.endpoint_gid)[:16]] = each.node_name
            time.sleep(0.0 if gid in self._names else POLL)
        return self._names.get(gid, gid.hex())
