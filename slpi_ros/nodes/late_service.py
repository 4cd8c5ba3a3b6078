"""A service that answers when what it started has ended."""

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from std_srvs.srv import Trigger


class LateService:
    """A service that answers later, without a thread that waits: neither of the executors may be blocked.

    Parameters
    ----------
    node : Node
    name : str
    start : callable
        Starts what is asked for; returns why it cannot, or "".
    """

    def __init__(self, node: Node, name: str, start: Callable[[], str]) -> None:
        self._start = start
        self._waiting: list[Any] = []
        self._service = node.create_service(Trigger, name, self._on_request)
        # The executors send what the callback returns; only here is known whom an answer is for.
        self._send = self._service.send_response
        self._service.send_response = self._send_or_keep

    def answer(self, success: bool, message: str) -> None:
        """Answer everyone who waits."""
        waiting, self._waiting = self._waiting, []
        for header in waiting:
            self._send(Trigger.Response(success=success, message=message), header)

    def _on_request(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message = self._start()
        return response

    def _send_or_keep(self, response: Trigger.Response, header: Any) -> None:
        if response.message:
            self._send(response, header)
        else:
            self._waiting.append(header)
