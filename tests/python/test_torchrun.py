"""Programs in several processes, as torchrun starts them: what is split, who prints, and what a lost process ends."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import torch
from test_processes import FORK, emulator
from trainings import frequent_checkpoints  # noqa: F401, a fixture of every test here

from prdp_torch.experiments import cli

ROOT = Path(__file__).parents[2]


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def torchrun(*arguments, **options):
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2"]
    command += ["--master-port", str(free_port()), *map(str, arguments)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


def until(exists, process, seconds=100):
    end = time.monotonic() + seconds
    while not exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.01)


def worker_of(launcher, rank):
    """The number of a process that torchrun has started."""
    for children in Path(f"/proc/{launcher.pid}/task").glob("*/children"):
        for child in children.read_text().split():
            if f"\0RANK={rank}\0" in Path(f"/proc/{child}/environ").read_text():
                return int(child)
    raise AssertionError("no such process")


def test_torchrun_ends_with_a_message_when_a_process_dies(tmp_path):
    launcher = torchrun(
        "-m", "prdp_torch", "train", emulator(tmp_path), "--prdp", "--out", tmp_path / "out", "--intervals", 100000
    )
    until((tmp_path / "out/prdp/seed_0.checkpoint").exists, launcher)
    os.kill(worker_of(launcher, 1), signal.SIGKILL)
    _, errors = launcher.communicate(timeout=60)
    assert launcher.returncode == 1 and "Signal 9 (SIGKILL) received" in errors
    assert not (tmp_path / "out/prdp/seed_0.json").exists()


def as_launched(rank, port, arguments, errors):
    """`prdp` as a launcher starts it, without one that looks after the others."""
    os.environ.update(RANK=str(rank), WORLD_SIZE="2", MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port))
    sys.argv = ["prdp", *arguments]
    torch.set_num_threads(1)
    with open(os.devnull, "w") as nowhere, open(errors, "w") as kept:
        sys.stdout, sys.stderr = nowhere, kept
        cli.main()


def launched(tmp_path, *arguments):
    port = free_port()
    team = [
        FORK.Process(target=as_launched, args=(rank, port, arguments, tmp_path / f"errors_{rank}")) for rank in range(2)
    ]
    for process in team:
        process.start()
    return team


def test_a_process_that_loses_another_one_says_so_and_ends(tmp_path):
    path = emulator(tmp_path)
    team = launched(tmp_path, "train", path, "--prdp", "--out", str(tmp_path / "out"), "--intervals", "100000")
    end = time.monotonic() + 100
    while not (tmp_path / "out/prdp/seed_0.checkpoint").exists():
        assert time.monotonic() < end and all(process.is_alive() for process in team)
        time.sleep(0.01)
    team[1].kill()
    team[0].join(60)
    assert team[0].exitcode == 2
    words = (tmp_path / "errors_0").read_text()
    assert words == "prdp: process 0 of 2: another process has ended, and this one with it\n"


def test_only_training_is_split_and_only_the_first_process_prints(tmp_path):
    team = launched(tmp_path, "compare", "heat_1d", "--out", str(tmp_path / "out"))
    for rank, process in enumerate(team):
        process.join(60)
        assert process.exitcode == 2
        words = "prdp: compare: runs in a single process; only train is split by torchrun\n"
        assert (tmp_path / f"errors_{rank}").read_text() == words
    team = launched(tmp_path, "train", "heat_1d", "--prdp", "--out", str(tmp_path / "out"), "--intervals", "3")
    for process in team:
        process.join(60)
        assert process.exitcode == 0
    assert "prdp: warning: seed 0" in (tmp_path / "errors_0").read_text()
    assert (tmp_path / "errors_1").read_text() == ""


COUNTS_THREADS = """
import runpy
from pathlib import Path
from torch import distributed

def destroy(destroy=distributed.destroy_process_group):
    destroy()
    names = [path.read_text() for path in Path("/proc/self/task").glob("*/comm")]
    print(f"{sum('gloo' in name for name in names)} threads left ")

distributed.destroy_process_group = destroy
runpy.run_path("examples/distributed.py", run_name="__main__")
"""


def test_the_example_of_a_loop_of_ones_own_has_one_k_and_leaves_no_thread(tmp_path):
    script = tmp_path / "counts_threads.py"
    script.write_text(COUNTS_THREADS)  # one that lets a tensor go after Python has ended aborts the process
    launcher = torchrun(script)
    output, errors = launcher.communicate(timeout=100)
    assert launcher.returncode == 0, errors
    assert output.count("0 threads left") == 2, output
    (k,) = set(re.findall(r"process [01] of 2: error (0\.\d+, K = \d+)", output))
    assert float(k.split(",")[0]) < 0.2 and int(k.split()[-1]) > 1
