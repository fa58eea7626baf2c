"""The command `prdp`, run as users run it."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
import types
from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest
from helpers import tiny

from prdp_torch.experiments import records

ROOT = Path(__file__).parents[2]
PRDP = [sys.executable, "-m", "prdp_torch"]
TRAINER = ROOT / "build" / "prdp_train"


def prdp(*arguments, cwd):
    return subprocess.run([*PRDP, *map(str, arguments)], cwd=cwd, capture_output=True, text=True)


@pytest.fixture(scope="module")
def comparison(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compare")
    done = prdp("compare", "heat_1d", "--seeds", 2, "--intervals", 4, cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder, done


def test_compare_prints_a_table_and_writes_records_and_a_report(comparison):
    folder, done = comparison
    for title in ("converged, K = 25", "direct solver", "auto", "PRDP", "PRDP, K ← 1.5 K", "K = 1", "K = 15"):
        assert title in done.stdout
    record = json.loads((folder / "runs/heat_1d/prdp/seed_1.json").read_text())
    assert record["seed"] == 1 and record["versions"]["torch"] and record["machine"]["cores"] >= 1
    assert "commit" in record and record["settings"]["scene"] == "heat_1d"
    curves = record["curves"]
    assert len(curves["metric"]) == 5 and len(curves["update_loss"]) == 32
    assert set(curves) == {
        "update_loss", "metric", "error", "max_iter", "budget", "iterations", "operator_applications",
        "adjoint_applications", "rtol", "failed", "seconds", "warning",
    }  # fmt: skip
    summary = json.loads((folder / "runs/heat_1d/summary.json").read_text())
    by_label = {row["label"]: row for row in summary["rows"]}
    assert by_label["converged"]["budget"] == 4 * 8 * 25 and by_label["constant_5"]["saved"] == pytest.approx(0.8)


def test_a_narrow_terminal_cuts_no_number(comparison):
    folder, _ = comparison
    command = [*PRDP, "compare", "heat_1d", "--seeds", "2", "--intervals", "4", "--resume"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env={**os.environ, "COLUMNS": "50"})
    rows = [line for line in done.stdout.splitlines() if re.match(r" K = \d", line)]
    assert len(rows) > 5 and not any("…" in row for row in rows)
    assert all(re.search(r"\de[+-]\d\d ±\de[+-]\d\d", row) for row in rows)


def test_the_report_is_one_file_with_labelled_pictures(comparison):
    folder, _ = comparison
    html = (folder / "runs/heat_1d/report.html").read_text()
    assert len(re.findall(r'<img alt="[^"]{30,}" src="data:image/svg\+xml;base64,', html)) == 6
    assert not re.search(r'(src|href)="(?!data:)', html)  # nothing is fetched from elsewhere


def test_resume_keeps_what_is_finished_and_redoes_what_is_not(comparison):
    folder, _ = comparison
    records = folder / "runs/heat_1d"
    kept, missing = records / "prdp/seed_0.json", records / "constant_5/seed_1.json"
    before = kept.stat().st_mtime_ns
    missing.unlink()
    done = prdp("compare", "heat_1d", "--seeds", 2, "--intervals", 4, "--resume", cwd=folder)
    assert done.returncode == 0 and missing.exists() and kept.stat().st_mtime_ns == before
    longer = prdp("train", "heat_1d", "--prdp", "--intervals", 5, "--resume", "--out", records, cwd=folder)
    assert longer.returncode == 2 and "of a finished training of 4 intervals, not 5; it cannot go on" in longer.stderr
    assert kept.stat().st_mtime_ns == before
    other = ("--backward", "unrolled", "--intervals", 5, "--resume")  # not the same training
    assert prdp("train", "heat_1d", "--prdp", *other, "--out", records, cwd=folder).returncode == 0
    assert kept.stat().st_mtime_ns > before


@pytest.mark.parametrize(
    "options, label", [([], "auto"), (["--constant", "3"], "constant_3"), (["--schedule", "2:1"], "schedule_2_1"),
                       (["--direct"], "direct"), (["--auto"], "auto"), (["--prdp"], "prdp")]
)  # fmt: skip
def test_train_writes_one_record_and_the_weights_of_each_seed(tmp_path, options, label):
    done = prdp("train", "heat_1d", *options, "--seeds", 2, "--intervals", 2, "--out", "here", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    written = sorted(path.name for path in (tmp_path / "here" / label).iterdir())
    assert written == ["seed_0.json", "seed_0.pt", "seed_1.json", "seed_1.pt"]


def test_scenes_are_listed(tmp_path):
    done = prdp("scenes", cwd=tmp_path)
    assert done.returncode == 0 and "heat_1d" in done.stdout and "poisson_3p_sd" in done.stdout


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["compare", "nosuch"], "prdp: no scene 'nosuch'; available: burgers_1d, burgers_2d, darcy_emulator"),
        (["compare", "nosuch.toml"], "prdp: scene: cannot read 'nosuch.toml'"),
        (
            ["train", "heat_1d", "--schedule", "3"],
            "prdp: --schedule: expected START:STEP, two whole numbers up to 1000000000, got '3'",
        ),
        (
            ["train", "heat_1d", "--schedule", "30:1"],
            "prdp: --schedule: START must be at most max_iter of the scene, 25, got 30",
        ),
        (["train", "heat_1d", "--prdp", "--direct"], "give one of --auto, --prdp, --constant, --schedule and --direct"),
        (
            ["train", "heat_1d", "--backward", "both"],
            "backward: expected implicit or unrolled for this scene, got 'both'",
        ),
        (["train", "heat_1d", "--out", "/proc/nothing"], "prdp: --out: cannot write to '/proc/nothing'"),
        (["train", "heat_1d", "--constant", "0"], "--constant"),
        (["train", "heat_1d", "--frobnicate"], "No such option"),
    ],
)
def test_mistakes_are_one_line_and_exit_2(tmp_path, arguments, message):
    done = prdp(*arguments, cwd=tmp_path)
    assert done.returncode == 2 and message in done.stderr
    assert "Traceback" not in done.stderr and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "command",
    [
        [*PRDP, "train", "heat_1d", "--seeds", "100", "--out", "."],
        [TRAINER, ROOT / "examples/scenes/heat_1d.toml", "--seeds", "100", "--out", "."],
    ],
    ids=["python", "cpp"],
)
def test_ctrl_c_keeps_what_is_finished_and_exits_130(tmp_path, command):
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    first = tmp_path / "auto/seed_0.json"
    for _ in range(600):
        if first.exists():
            break
        time.sleep(0.1)
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130 and b"interrupted" in errors
    assert json.loads(first.read_text())["curves"]["metric"]
    assert not list(tmp_path.rglob("*.part"))


def test_prdp_train_ends_soon_while_data_are_made_and_its_log_can_be_followed(tmp_path):
    scene = tmp_path / "slow.toml"  # its data take minutes
    text = (ROOT / "examples/scenes/burgers_2d.toml").read_text()
    scene.write_text(re.sub(r"shape = \[\d+, \d+\]", "shape = [192, 192]", text))
    with open(tmp_path / "log", "w") as log:
        process = subprocess.Popen([TRAINER, scene, "--out", tmp_path], stdout=log, stderr=subprocess.PIPE)
    for _ in range(600):
        if (tmp_path / "log").read_text():
            break
        time.sleep(0.1)
    time.sleep(1)
    assert process.poll() is None and (tmp_path / "log").read_text().startswith("slow: auto, ")
    begin = time.monotonic()
    process.terminate()
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM and b"interrupted" in errors
    assert time.monotonic() - begin < 5


@pytest.mark.parametrize("full", [False, True])
def test_work_goes_on_where_nobody_takes_the_output(tmp_path, full):
    """As `prdp compare … | head`, and with a disk that is full."""
    run = tmp_path / "run"
    command = [*PRDP, "compare", tiny(tmp_path), *["--intervals", "1", "--seeds", "1", "--out"], run]
    if full:
        with open("/dev/full", "w") as output:
            done = subprocess.run(command, stdout=output, stderr=subprocess.PIPE, text=True)
    else:
        read, write = os.pipe()
        os.close(read)
        done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True)
        os.close(write)
    lost = "prdp: warning: standard output: No space left on device; the work goes on without it\n"
    assert (done.returncode, done.stderr) == (0, lost if full else "")
    assert (run / "report.html").exists()


def test_prdp_train_goes_on_where_nobody_takes_its_lines(tmp_path):
    read, write = os.pipe()
    os.close(read)
    command = [TRAINER, ROOT / "examples/scenes/heat_1d.toml", "--intervals", "20", "--out", tmp_path]
    assert subprocess.run(command, stdout=write, check=False).returncode == 0
    os.close(write)
    assert (tmp_path / "auto/seed_0.json").exists()


@pytest.mark.parametrize("words", ["scenes", "--version", "train --help"])
def test_a_closed_or_full_standard_output_is_no_error(words):
    for output in ("&-", "/dev/full"):
        done = subprocess.run(f"{shlex.join(PRDP)} {words} >{output}", shell=True, stderr=subprocess.PIPE, text=True)
        assert done.returncode == 0 and "Traceback" not in done.stderr


@pytest.mark.parametrize("ignored", [False, True])
def test_ctrl_c_while_torch_is_imported_is_quiet(tmp_path, ignored):
    """With a torch that presses Ctrl-C; in the background, where it is ignored, it stays so."""
    (tmp_path / "torch.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\nprint('went on')\n")
    setting = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); " if ignored else ""
    done = subprocess.run(
        [sys.executable, "-c", setting + "from prdp_command import main; main()", "scenes"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    if ignored:
        assert done.stdout == "went on\n" and "module 'torch' has no attribute" in done.stderr
    else:
        assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["nosuch.toml"], "prdp_train: scene: cannot read 'nosuch.toml'"),
        (
            [ROOT / "examples/scenes/heat_1d.toml", "--schedule", "3"],
            "expected START:STEP, two whole numbers up to 1000000000, got '3'",
        ),
        (
            [ROOT / "examples/scenes/heat_1d.toml", "--schedule", "30:1"],
            "START must be at most max_iter of the scene, 25",
        ),
        ([ROOT / "examples/scenes/heat_1d.toml", "--out", "/proc/nothing"], "prdp_train: "),
    ],
)
def test_the_cpp_trainer_says_what_is_wrong(tmp_path, arguments, message):
    done = subprocess.run([TRAINER, *arguments], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2 and message in done.stderr and not list(tmp_path.iterdir())


def test_the_quickstart_tightens_its_tolerance(tmp_path):
    done = subprocess.run(
        [sys.executable, ROOT / "examples/quickstart.py"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0 and done.stdout.endswith("The controller warns of nothing.\n"), done.stderr
    tolerances = [float(rtol) for rtol in re.findall(r"tolerance (\S+)", done.stdout)]
    assert len(tolerances) > 5 and tolerances == sorted(tolerances, reverse=True) and tolerances[-1] < 0.07


@pytest.mark.parametrize(
    "module, file, program",
    [
        (None, "bin/prdp", "prdp"),
        ("pack.tool.__main__", "__main__.py", "python -m pack.tool"),
        ("pack.tool", "tool.py", "python -m pack.tool"),
    ],
)
def test_a_record_names_the_command_so_that_it_can_be_given_again(monkeypatch, module, file, program):
    main = types.SimpleNamespace(__spec__=module and ModuleSpec(module, None))
    monkeypatch.setitem(sys.modules, "__main__", main)
    monkeypatch.setattr(sys, "argv", [f"/somewhere/{file}", "compare", "heat_1d"])
    assert records.environment()["command"] == f"{program} compare heat_1d"
