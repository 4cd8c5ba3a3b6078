"""Memory that a large message needed is used again for the next one."""

import subprocess
import sys

PROGRAM = """
import resource
from slpi_ros.nodes.common import keep_freed_memory

def pages_for_a_message():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    bytearray(40_000_000)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

{}
print(pages_for_a_message(), pages_for_a_message())
"""


def pages(call: str) -> tuple[int, ...]:
    done = subprocess.run([sys.executable, "-c", PROGRAM.format(call)], capture_output=True, text=True, check=True)
    return tuple(map(int, done.stdout.split()))


def test_a_second_large_message_needs_no_new_pages():
    first, second = pages("keep_freed_memory()")
    assert second < 0.01 * first


def test_without_it_each_large_message_does():
    first, second = pages("")
    assert second > 0.5 * first
