"""The meter counts what passes through a process, whichever way it goes."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.heavy

MOVES = """
import os, socket, sys, tempfile, threading
from workers.bench.traffic import TrafficMeter

def exchange(ends, size):
    sender = threading.Thread(target=ends[0].sendall, args=(bytes(size),))
    sender.start()
    while size:
        size -= len(ends[1].recv(65536))
    sender.join()

meter = TrafficMeter(with_ray=False)
start = meter.count()
with tempfile.TemporaryFile() as file:
    file.write(bytes(1_000_000))
    file.seek(0)
    file.read()
files = meter.count()
with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as one:
    other = server.accept()[0]
    exchange((one, other), 3_000_000)
    tcp = meter.count()
    other.close()
exchange(socket.socketpair(), 2_000_000)
unix = meter.count()
print(files - start, tcp - files, unix - tcp, meter.count() - unix)
"""

ON_RAY = """
import ray
from workers.bench.traffic import TrafficMeter

@ray.remote
class Echo:
    def give(self, data):
        return data
    def pass_by(self, data):
        return len(data)

meter = TrafficMeter(with_ray=True)
ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
echo = Echo.remote()
ray.get(echo.give.remote(b""))
counts = [meter.count()]
for size, times in ((50_000, 20), (1_000_000, 5)):
    for _ in range(times):
        ray.get(echo.give.remote(bytes(size)))
    counts.append(meter.count())
reference = echo.give.remote(ray.put(bytes(2_000_000)))
ray.get(echo.pass_by.remote(reference))
counts.append(meter.count())
print(*(after - before for before, after in zip(counts, counts[1:])))
"""


def _measure(script: str) -> list[int]:
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=120)
    return [int(word) for word in done.stdout.split()]


def test_files_and_both_ends_of_sockets_count():
    files, tcp, unix, nothing = _measure(MOVES)
    assert (files, tcp, unix) == pytest.approx((2_000_000, 6_000_000, 4_000_000), abs=100_000)
    assert 0 <= nothing < 20_000, "what was counted stays when connections end"


@pytest.mark.slow  # starts Ray, for a figure of a bench
def test_what_goes_to_ray_and_comes_back_counts_but_not_what_passes_by():
    small, large, referred = _measure(ON_RAY)
    assert small == pytest.approx(2 * 20 * 50_000, rel=0.05), "sent with the call"
    assert large == pytest.approx(2 * 5 * 1_000_000, rel=0.05), "through the object store"
    assert referred == pytest.approx(2_000_000, rel=0.05), "put once, never fetched"
