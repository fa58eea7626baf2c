"""Checkpoints: trainings that are stopped in this process and go on bit for bit, and the file that they keep."""

import time

import pytest
import torch
from trainings import (  # noqa: F401, a fixture of every test here
    checkpoint_of,
    frequent_checkpoints,
    restored,
    scene_of,
    state,
    without_seconds,
)

import prdp_torch as prdp
from prdp_torch.experiments import compare, records, scenes
from prdp_torch.experiments.checkpoint import Checkpoint
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

# ---- trainings that are interrupted in this process


class Stopped(Exception):
    pass


def stop_after(interval):
    def callback(done):
        if done.number == interval:
            raise Stopped

    return callback


class Linear(torch.nn.Module):
    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.layer = torch.nn.Linear(30, 30)

    def forward(self, u):
        return self.layer(u)


@pytest.mark.parametrize(
    "task, refine, make_network",
    [
        ("emulator", lambda scene: Refinement.prdp(scene, growth=1.5), None),
        ("emulator", Refinement.prdp, Linear),
        ("emulator", lambda scene: Refinement.schedule(2, 3, 25), None),
        ("emulator", lambda scene: Refinement.exact(), None),
        ("parameters", lambda scene: Refinement.schedule(25, 6, 600), None),
        ("corrector", lambda scene: Refinement.constant(2), None),
        ("field", lambda scene: Refinement.auto(), None),
    ],
)
def test_every_kind_of_training_goes_on_from_any_interval(tmp_path, task, refine, make_network):
    scene = scenes.load(scene_of(task, tmp_path))
    scene.training.intervals = 12

    def curves(checkpoint=None, *callbacks):
        network = make_network() if make_network else None
        return train(scene, refine(scene), network=network, callbacks=callbacks, checkpoint=checkpoint)

    alone = curves()
    checkpoint = Checkpoint(tmp_path / "kept")
    reports = []
    for interval in (1, 2, 6, 11):
        with pytest.raises(Stopped):
            curves(checkpoint, stop_after(interval))
    assert without_seconds(curves(checkpoint, reports.append)) == without_seconds(alone)
    assert [report.number for report in reports] == list(range(1, 13))
    assert [report.resumed for report in reports] == [True] * 11 + [False]
    assert [report.metric for report in reports] == alone["metric"][1:]


def recorded(scene, folder, resume, *callbacks, seed=0):
    environment = records.environment()
    return compare.run_one(scene, "prdp", Refinement.prdp(scene), seed, folder, environment, resume, callbacks)


def test_only_resume_with_the_same_settings_goes_on(tmp_path):
    folder, scene = tmp_path / "here", scenes.load("heat_1d")
    scene.training.intervals = 8

    def already_done(**changes):
        """How many intervals a training finds done that follows a stopped one."""
        scene.training.intervals = 8
        with pytest.raises(Stopped):
            recorded(scene, folder, False, stop_after(5))
        scene.training.intervals = changes.pop("intervals", 8)
        reports = []
        recorded(scene, folder, changes.pop("resume", True), reports.append, **changes)
        checkpoint = folder / "prdp/seed_0.checkpoint"
        assert checkpoint.exists() == ("seed" in changes)  # another training's is left alone
        (folder / "prdp/seed_0.json").unlink(missing_ok=True)
        return sum(report.resumed for report in reports)

    assert already_done() == already_done(intervals=9) == 5
    assert already_done(resume=False) == already_done(seed=1) == 0
    with pytest.raises(ValueError, match="of a training that has done 5 intervals, more than the 4 asked for"):
        already_done(intervals=4)


def test_a_finished_record_needs_no_checkpoint(tmp_path):
    scene = scenes.load("heat_1d")
    scene.training.intervals = 2
    curves = recorded(scene, tmp_path, False)
    assert sorted(path.name for path in (tmp_path / "prdp").iterdir()) == ["seed_0.json", "seed_0.pt"]
    assert recorded(scene, tmp_path, True) == curves
    (tmp_path / "prdp/seed_0.json").write_text("{")
    with pytest.raises(
        ValueError, match=r"record: '.*seed_0.json' is damaged or of another version: its content .*; delete it"
    ):
        recorded(scene, tmp_path, True)


def test_a_loop_of_ones_own_goes_on_as_the_readme_says(tmp_path):
    class Loop:
        def __init__(self):
            torch.manual_seed(0)
            self.heat = prdp.Heat((30,), nu=1e-3, dt=1.0, solver=prdp.Jacobi(max_iter=1))
            self.network = Linear()
            self.optimiser = torch.optim.Adam(self.network.parameters(), lr=3e-3)
            self.controller = prdp.PRDPController([self.heat], window=1, delta=2, tau_step=0.9)
            self.u0 = torch.randn(40, 1, 30, generator=torch.Generator().manual_seed(1))

        def epochs(self, count):
            for _ in range(count):
                for batch in torch.randperm(40).split(10):
                    self.optimiser.zero_grad()
                    loss = (self.heat(self.network(self.u0[batch])) - 0.5 * self.u0[batch]).square().mean()
                    loss.backward()
                    self.optimiser.step()
                self.controller.step(loss.detach())

    whole = Loop()
    whole.epochs(20)
    first = Loop()
    first.epochs(8)
    parts = {"network": first.network, "optimiser": first.optimiser, "controller": first.controller}
    states = {name: part.state_dict() for name, part in parts.items()}
    torch.save({**states, "random": torch.get_rng_state()}, tmp_path / "training.pt")

    rest = Loop()
    saved = torch.load(tmp_path / "training.pt")
    rest.network.load_state_dict(saved["network"])
    rest.optimiser.load_state_dict(saved["optimiser"])
    rest.controller.load_state_dict(saved["controller"])
    torch.set_rng_state(saved["random"])
    assert rest.heat.max_iter == first.heat.max_iter > 1
    rest.epochs(12)
    assert rest.controller.history == whole.controller.history and rest.heat.max_iter > first.heat.max_iter
    assert torch.equal(rest.network.layer.weight, whole.network.layer.weight)


# ---- the file


def test_a_state_comes_back_and_another_settings_does_not(tmp_path):
    path = tmp_path / "kept"
    checkpoint = checkpoint_of(path, text="two\nlines")
    assert checkpoint.find() == [] and restored(checkpoint) is None
    tensors, curves, controller = state(3)
    checkpoint.save({**tensors, "u": torch.tensor([1.0, float("inf")]), "shared": tensors["theta"]}, curves, controller)

    def load(saved):
        assert saved.take("u", torch.zeros(2), finite=False).tolist() == [1.0, float("inf")]
        assert float(saved.take("theta", torch.zeros(()))) == float(saved.take("shared", torch.zeros(()))) == 3.0
        kept = {name: value for name, value in controller.items() if name != "controller"}
        assert saved.progress(1) == (curves, {**kept, "history": list(map(tuple, controller["history"]))})

    again = checkpoint_of(path, text="two\nlines")
    assert again.restore(again.find(), load)
    other = checkpoint_of(path, text="two\nlines", seed=1)
    with pytest.warns(UserWarning, match=f"'{path}' is of other settings or another version; it is not used"):
        assert restored(other) is None
    assert list(tmp_path.iterdir()) == [path]
    checkpoint.remove()
    checkpoint.remove()
    assert restored(checkpoint) is None and list(tmp_path.iterdir()) == []


def test_two_checkpoints_are_kept(tmp_path):
    path = tmp_path / "kept"
    before = tmp_path / "kept.before"
    checkpoint = checkpoint_of(path)
    for number in range(3):
        checkpoint.save(*state(number))
        assert restored(checkpoint) == number and checkpoint.notice == ""
    whole = path.read_bytes()
    for damage in (whole[:-1], b"", b"something else\n", whole.replace(b"seed", b"need")):
        path.write_bytes(damage)
        words = f"'{path}' is damaged or of another version: its content .*; the training goes on from the one before"
        with pytest.warns(UserWarning, match=words):
            assert restored(checkpoint) == 1
    checkpoint_of(path, seed=7).save(*state(9))
    checkpoint_of(tmp_path / "other").save(*state(5))
    (tmp_path / "other").rename(before)
    with pytest.warns(UserWarning, match=f"'{path}' is of other settings or another version; it is not used"):
        assert restored(checkpoint) == 5
    path.unlink()
    assert restored(checkpoint) == 5
    before.write_bytes(b"damaged")
    with pytest.raises(ValueError, match=f"checkpoint: '{before}' is damaged or of another version: .*; delete it"):
        restored(checkpoint)
    checkpoint.remove()
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_checkpoint_does_not_take_the_place_of_the_good_one_before(tmp_path):
    checkpoint = checkpoint_of(tmp_path / "kept")
    for number in range(2):
        checkpoint.save(*state(number))
    (tmp_path / "kept").write_bytes(b"damaged")
    with pytest.warns(UserWarning, match="goes on from the one before"):
        assert restored(checkpoint) == 0
    checkpoint.save(*state(2))
    (tmp_path / "kept").write_bytes(b"damaged again")
    with pytest.warns(UserWarning, match="goes on from the one before"):
        assert restored(checkpoint) == 0
    checkpoint.save(*state(3))
    checkpoint.save(*state(4))
    (tmp_path / "kept").unlink()
    assert restored(checkpoint) == 3


def test_a_changed_byte_or_a_missing_end_is_found(tmp_path):
    path = tmp_path / "kept"
    checkpoint = checkpoint_of(path)
    checkpoint.save(*state(1))
    whole = path.read_bytes()
    changed = (whole[:i] + bytes([whole[i] ^ 1]) + whole[i + 1 :] for i in range(0, len(whole), 3))
    for damaged in (*changed, *(whole[:n] for n in range(0, len(whole), 50)), whole + b"\0"):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=f"checkpoint: '{path}' is damaged or of another version: .*; delete it"):
            checkpoint.find()
    path.write_bytes(whole)
    assert restored(checkpoint) == 1


def test_a_checkpoint_that_cannot_be_written_leaves_the_last_one(tmp_path):
    folder, elsewhere = tmp_path / "here", tmp_path / "elsewhere"
    folder.mkdir()
    checkpoint = checkpoint_of(folder / "kept")
    checkpoint.save(*state(1))
    folder.rename(elsewhere)
    with pytest.raises(ValueError, match=f"cannot write '{folder}/kept': No such file or directory"):
        checkpoint.save(*state(2))
    elsewhere.rename(folder)
    assert restored(checkpoint) == 1


def test_a_network_that_a_checkpoint_cannot_keep_is_refused_before_any_work(tmp_path):
    class Talking(Linear):
        def get_extra_state(self):
            return {"epoch": 1}

        def set_extra_state(self, state):
            pass

    scene = scenes.load("heat_1d")
    scene.training.intervals = 1
    train(scene, Refinement.constant(1), network=Talking())
    with pytest.raises(TypeError, match="must hold tensors only, for its checkpoint, got dict for '_extra_state'"):
        train(scene, Refinement.constant(1), network=Talking(), checkpoint=Checkpoint(tmp_path / "kept"))


def test_checkpoints_are_ten_seconds_apart_or_as_the_environment_says(tmp_path, monkeypatch):
    assert Checkpoint(tmp_path / "kept").due()
    monkeypatch.setenv("PRDP_CHECKPOINT_SECONDS", "0.05")
    checkpoint = Checkpoint(tmp_path / "kept")
    time.sleep(0.06)
    assert checkpoint.due()
    monkeypatch.delenv("PRDP_CHECKPOINT_SECONDS")
    assert not Checkpoint(tmp_path / "kept").due()
    scene = scenes.load("heat_1d")
    scene.training.intervals = 3
    train(scene, Refinement.prdp(scene), checkpoint=Checkpoint(tmp_path / "none"))
    assert not (tmp_path / "none").exists()
    for wrong in ("soon", "-1", "nan"):
        monkeypatch.setenv("PRDP_CHECKPOINT_SECONDS", wrong)
        with pytest.raises(ValueError, match=f"PRDP_CHECKPOINT_SECONDS: expected a number >= 0, got '{wrong}'"):
            Checkpoint(tmp_path / "kept")
