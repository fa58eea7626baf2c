"""Several processes that train one network, over gloo on this machine."""

import json
import multiprocessing
import os
import warnings

import pytest
import torch
from helpers import tiny, written
from torch import distributed
from trainings import frequent_checkpoints  # noqa: F401, a fixture of every test here

import prdp_torch as prdp
from prdp_torch import data_parallel
from prdp_torch.experiments import compare, records, scenes
from prdp_torch.experiments.refinement import Refinement

# One process imports torch, and those of the tests are forked from it before it has a thread.
FORK = multiprocessing.get_context("forkserver")
FORK.set_forkserver_preload(["helpers", "prdp_torch.experiments.cli"])
DOUBLE = (('dtype = "float32"', 'dtype = "float64"'),)


def emulator(tmp_path):
    return written(
        tmp_path,
        *DOUBLE,
        ("batch = 25", "batch = 64"),
        ("delta = 3", "delta = 2"),
        ("tau_step = 0.98", "tau_step = 0.5"),
    )


def corrector(tmp_path):
    return tiny(tmp_path, *DOUBLE, ("train = 8", "train = 7"), ("batch = 2", "batch = 4"))


def _one(environment, work, rank, count, meeting, *arguments):
    os.environ.update(environment)  # a server of forks has that of the test that started it
    torch.set_num_threads(1)
    distributed.init_process_group("gloo", init_method=f"file://{meeting}", rank=rank, world_size=count)
    work(*arguments)
    distributed.barrier()
    distributed.destroy_process_group()


def together(count, tmp_path, work, *arguments):
    """Run `work(*arguments)` in so many processes."""
    meeting = tmp_path / f"meeting_{len(list(tmp_path.iterdir()))}"
    team = [
        FORK.Process(target=_one, args=(dict(os.environ), work, rank, count, meeting, *arguments))
        for rank in range(count)
    ]
    for process in team:
        process.start()
    for process in team:
        process.join(120)
    assert [process.exitcode for process in team] == [0] * count


def train(path, folder, intervals, resume=False, stop=None):
    """Train and write the record; `stop` ends the process after so many intervals."""
    scene = scenes.load(path)
    scene.training.intervals = intervals

    def end(interval):
        if interval.number == stop:
            distributed.barrier()
            os._exit(0)

    environment = records.environment()
    compare.run_one(scene, "prdp", Refinement.prdp(scene), 0, folder, environment, resume, [end])


def result(folder):
    """The record of a training, and its weights as one tensor."""
    weights = torch.load(folder / "prdp/seed_0.pt", weights_only=True)
    return json.loads((folder / "prdp/seed_0.json").read_text()), torch.cat([w.flatten() for w in weights.values()])


def expect_same(one, other):
    """The same training to rounding."""
    (record, weights), (others, other_weights) = one, other
    torch.testing.assert_close(weights, other_weights, rtol=1e-9, atol=1e-12)
    assert record["curves"].keys() == others["curves"].keys()
    for name, values in record["curves"].items():
        if name in ("max_iter", "budget"):
            assert values == others["curves"][name]
        elif name not in ("seconds", "warning"):
            assert values == pytest.approx(others["curves"][name], rel=1e-9)


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("scene, intervals", [(emulator, 10), (corrector, 2)])
def test_several_processes_train_as_one_does(tmp_path, scene, intervals, count):
    path = scene(tmp_path)
    train(path, tmp_path / "one", intervals)
    together(count, tmp_path, train, path, tmp_path / "many", intervals)
    one, many = result(tmp_path / "one"), result(tmp_path / "many")
    expect_same(many, one)
    assert scene is corrector or len(set(one[0]["curves"]["max_iter"])) > 1
    assert [r["machine"]["processes"] for r, _ in (one, many)] == [1, count]
    assert sorted(path.name for path in (tmp_path / "many/prdp").iterdir()) == ["seed_0.json", "seed_0.pt"]


def test_processes_that_are_stopped_go_on_bit_for_bit_and_one_process_goes_on_from_them(tmp_path):
    path = emulator(tmp_path)
    together(2, tmp_path, train, path, tmp_path / "alone", 8)
    for folder in ("many", "one"):
        together(2, tmp_path, train, path, tmp_path / folder, 8, False, 5)
        assert (tmp_path / folder / "prdp/seed_0.checkpoint").exists()
    together(2, tmp_path, train, path, tmp_path / "many", 8, True)
    train(path, tmp_path / "one", 8, resume=True)
    alone, many, one = (result(tmp_path / folder) for folder in ("alone", "many", "one"))
    assert torch.equal(alone[1], many[1])
    for record, _ in (alone, many):
        del record["curves"]["seconds"]
    assert alone[0]["curves"] == many[0]["curves"]
    expect_same(one, (many[0] | {"curves": many[0]["curves"] | {"seconds": []}}, many[1]))


# ---- controllers in a loop of one's own


def steps_of(make, metrics, path):
    """Step a controller with this process's row of metrics, and write down what it did."""
    rank = distributed.get_rank()
    controller = make()
    for metric in metrics[rank]:
        controller.step(metric)
    path.with_suffix(f".{rank}").write_text(repr((controller.max_iter, controller.history)))


def impatient():
    return prdp.PRDPController(window=1, delta=2, tau_step=0.9)


def of_this_process_alone():
    group, _ = distributed.new_subgroups(group_size=1)
    return prdp.PRDPController(window=1, delta=2, tau_step=0.9, process_group=group)


@pytest.mark.filterwarnings("ignore:.*said once")
def test_controllers_refine_in_the_same_interval_on_all_processes(tmp_path):
    dice = torch.Generator().manual_seed(0)
    metrics = (torch.rand(2, 60, generator=dice, dtype=torch.float64) * 0.9 ** torch.arange(60)).tolist()
    means = [(a + b) / 2 for a, b in zip(*metrics, strict=True)]

    def alone(make, row):
        controller = make()
        for metric in row:
            controller.step(metric)
        return repr((controller.max_iter, controller.history))

    for make in (impatient, prdp.ToleranceController):
        together(2, tmp_path, steps_of, make, metrics, tmp_path / "history")
        both = [(tmp_path / f"history.{rank}").read_text() for rank in range(2)]
        assert both == [alone(make, means)] * 2 != [alone(make, row) for row in metrics]
    together(2, tmp_path, steps_of, of_this_process_alone, metrics, tmp_path / "history")
    both = [(tmp_path / f"history.{rank}").read_text() for rank in range(2)]
    assert both == [alone(impatient, row) for row in metrics]


def controllers_that_differ(path):
    rank = distributed.get_rank()
    controller = prdp.PRDPController(initial=2)
    if rank == 0:  # as if it were the weights of a network, which one process hands to the others
        controller.load_state_dict({**controller.state_dict(), "max_iter": 7})
    for made, what in (
        (controller, "max_iter is 2 and 7"),
        (prdp.ToleranceController(ratio=0.1 + 0.1 * rank), "ratio is 0.1 and 0.2"),
        (prdp.PRDPController(maximum=9 if rank else None), "maximum is None and 9"),
    ):
        with pytest.raises(RuntimeError, match=rf"the controllers of 2 processes disagree: {what}; make them with the"):
            made.step(1.0)


def test_controllers_that_differ_between_processes_are_refused_in_all(tmp_path):
    together(2, tmp_path, controllers_that_differ, tmp_path)


def reports_and_refusals(path):
    rank = distributed.get_rank()
    u = torch.randn(5, 1, 30, generator=torch.Generator().manual_seed(0))
    heat = prdp.Heat((30,), nu=1e-3, dt=1.0, solver=prdp.Jacobi(max_iter=4))
    controller = prdp.PRDPController([heat], initial=4)
    heat(u.tensor_split([2])[rank])
    controller.step(1.0, error=0.5)
    controller.step(1.0, error=0.5 if rank else None)
    first, second = controller.history
    assert first.error == 0.5 and second.error is None
    heat(u)
    torch.testing.assert_close(first.residual, float(heat.info.residual.double().mean()), rtol=1e-12, atol=0)
    for wrong in (-1.0 if rank else 3.0, float("nan") if rank else 3.0):
        with pytest.raises(ValueError, match=f"metric must be finite and >= 0, got {'-1' if wrong < 0 else 'nan'}"):
            controller.step(wrong)
    assert len(controller.history) == 2
    # All have to meet the tolerance before that keeps K.
    kept = prdp.PRDPController(window=1, delta=2)
    for _ in range(3):
        kept.step(1.0, converged=bool(rank))
    assert kept.max_iter == 2
    group = distributed.new_group([0])
    if rank == 1:
        with pytest.raises(ValueError, match="PRDPController: this process does not belong to process_group"):
            prdp.PRDPController(process_group=group)
    else:
        with pytest.raises(TypeError, match="only a controller of the default process group can be copied"):
            prdp.PRDPController(process_group=group).__reduce__()
    scene = scenes.load(path)
    with pytest.raises(ValueError, match="2 processes need as many samples in each batch, but a batch has 1"):
        prdp.experiments.training.train(scene, Refinement.prdp(scene))
    scene = scenes.load("poisson_1p")
    with pytest.raises(ValueError, match="share the batches of a network; the task 'parameters' has none"):
        prdp.experiments.training.train(scene, Refinement.prdp(scene))


def test_what_controllers_report_and_refuse_is_the_same_on_all_processes(tmp_path):
    together(2, tmp_path, reports_and_refusals, written(tmp_path, ("batch = 25", "batch = 199")))


def test_a_group_must_be_one():
    with pytest.raises(
        TypeError, match=r"PRDPController: process_group must be a group of torch.distributed, got 'all'"
    ):
        prdp.PRDPController(process_group="all")
    assert data_parallel.count() == 1 and data_parallel.sums([1.5]) == [1.5]


# ---- GPUs


def find_group(folder, gpus):
    """Which group sums the gradients of processes with these GPUs, as a computer with NCCL chooses it."""
    device, made = torch.device("cuda", 0), []
    data_parallel._name_of_gpu = lambda device: ("host", gpus[distributed.get_rank()])
    distributed.is_nccl_available = lambda: True
    distributed.new_group = lambda backend: made.append(backend) or "group"
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        groups = [data_parallel.gradient_group(device) for _ in range(2)]
    on_cpu = data_parallel.gradient_group(torch.device("cpu"))
    found = {"groups": groups, "made": made, "said": [str(one.message) for one in said[:1]], "cpu": on_cpu}
    (folder / f"rank_{distributed.get_rank()}").write_text(json.dumps(found))


@pytest.mark.parametrize("gpus, words", [("ab", None), ("aa", "2 processes share 1 GPU: gloo sums their gradients")])
def test_nccl_sums_gradients_where_no_two_processes_share_a_gpu(tmp_path, gpus, words):
    together(2, tmp_path, find_group, tmp_path, gpus)
    for rank in range(2):
        found = json.loads((tmp_path / f"rank_{rank}").read_text())
        assert found["groups"] == [None if words else "group"] * 2 and found["cpu"] is None
        assert found["made"] == ([] if words else ["nccl"])  # once for all trainings
        assert [said.startswith(words) for said in found["said"]] == ([True] if words and rank == 0 else [])


def test_each_process_takes_a_gpu_of_its_own_as_far_as_there_are_some(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert data_parallel.own_gpu(torch.device("cuda")) == torch.device("cuda")  # alone
    monkeypatch.setattr(data_parallel, "count", lambda: 4)
    monkeypatch.setattr(distributed, "get_rank", lambda: 3)
    for local, expected in enumerate((0, 1, 0, 1)):
        monkeypatch.setenv("LOCAL_RANK", str(local))
        assert data_parallel.own_gpu(torch.device("cuda")) == torch.device("cuda", expected)
        assert data_parallel.own_gpu(torch.device("cuda", 1)) == torch.device("cuda", 1)
        assert data_parallel.own_gpu(torch.device("cpu")) == torch.device("cpu")
    scene = scenes.load("heat_1d")
    with monkeypatch.context() as patch:  # the GPU that is looked for, and used, is the process's own
        patch.setenv("LOCAL_RANK", "1")
        patch.setattr(scenes._C, "find_device", torch.device)
        assert scenes.placed(scene, "cuda").device == torch.device("cuda", 1)
    monkeypatch.delenv("LOCAL_RANK")
    assert data_parallel.own_gpu(torch.device("cuda")) == torch.device("cuda", 1)  # by the rank
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    assert data_parallel.own_gpu(torch.device("cuda")) == torch.device("cuda")  # which is not there, as others will say
