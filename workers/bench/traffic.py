"""Bytes that pass through this process, counted below the code that moves them, for `tableverse bench factory`."""

import os
import socket
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

_TCP_INFO_BYTES = 256
_COUNTERS = struct.Struct("<QQ")  # bytes that the other end acknowledged, and bytes received (linux/tcp.h, tcp_info)
_COUNTERS_AT = 120
_INLINE_BYTES = 100 * 1024  # largest argument or result that Ray sends with the call; larger ones rest in its store


class TrafficMeter:
    """Meter of what this process reads, writes, sends and receives. There is one per process.

    It adds up calls that read and write files and pipes (`/proc/self/io`); TCP connections, by the kernel's counters,
    with Ray's calls, arguments and small results; Unix sockets of Python code; and objects above 100 KB that go into
    Ray's object store or come out of it, which is shared memory. It leaves out files that are mapped, Ray's Unix
    sockets to its own processes, and the last bytes of a connection that ends between two counts.
    """

    def __init__(self, with_ray: bool) -> None:
        """Start to count; `with_ray` for a process that uses Ray."""
        self._tcp_bytes: dict[int, int] = {}  # of open connections, by inode
        self._total_bytes = 0
        for name in ("send", "recv_into"):
            self._count_unix_calls(name, lambda _, moved: int(moved))
        self._count_unix_calls("sendall", lambda data, _: memoryview(data).nbytes)
        self._count_unix_calls("recv", lambda _, data: len(data))
        if with_ray:
            self._count_objects()

    def count(self) -> int:
        """Count the bytes up to now; what passed before the first count is in it."""
        found = _read_tcp_counters()
        for inode, seen in found.items():
            before = self._tcp_bytes.get(inode, 0)
            self._total_bytes += seen - before if seen >= before else seen  # else a new one has the inode
        self._tcp_bytes = found
        io = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
        return self._total_bytes + int(io["rchar"]) + int(io["wchar"])

    def _count_unix_calls(self, name: str, measure: Callable[[Any, Any], int]) -> None:
        """Wrap a method of all sockets; `measure` returns the bytes for its first argument and its result."""
        original = getattr(socket.socket, name)

        def call(its: socket.socket, first: Any, *rest: Any) -> Any:
            result = original(its, first, *rest)
            if its.family == socket.AF_UNIX:
                self._total_bytes += measure(first, result)
            return result

        setattr(socket.socket, name, call)

    def _count_objects(self) -> None:
        """Wrap what gives objects to Ray and gets them."""
        import ray
        import ray.actor

        get, put, method = ray.get, ray.put, ray.actor.ActorHandle._actor_method_call

        def get_counted(*args: Any, **kwargs: Any) -> Any:
            value = get(*args, **kwargs)
            self._total_bytes += _sum_large_bytes(value)
            return value

        def put_counted(value: Any, **kwargs: Any) -> Any:
            self._total_bytes += _sum_large_bytes(value)
            return put(value, **kwargs)

        def call_counted(handle: Any, method_name: str, args: Any = None, **kwargs: Any) -> Any:
            self._total_bytes += _sum_large_bytes(args)
            return method(handle, method_name, args=args, **kwargs)

        ray.get, ray.put, ray.actor.ActorHandle._actor_method_call = get_counted, put_counted, call_counted


def _sum_large_bytes(value: Any) -> int:
    if isinstance(value, list | tuple):
        return sum(map(_sum_large_bytes, value))
    return len(value) if isinstance(value, bytes) and len(value) > _INLINE_BYTES else 0


def _read_tcp_counters() -> dict[int, int]:
    """Read the bytes sent and received on the open TCP connections of this process, by inode."""
    counters = {}
    for path in Path("/proc/self/fd").iterdir():
        try:
            if not path.is_socket():
                continue
            with socket.socket(fileno=os.dup(int(path.name))) as its:
                info = its.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO_BYTES)
                counters[os.fstat(its.fileno()).st_ino] = sum(_COUNTERS.unpack_from(info, _COUNTERS_AT))
        except OSError:  # closed since it was listed, or no TCP
            continue
    return counters
