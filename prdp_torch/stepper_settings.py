"""The settings of a stepper: how they are set and checked, and how the compiled library gets them."""

import difflib
import functools
import struct
from collections.abc import Callable
from operator import is_
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from prdp_torch import _C, _check, operators, torch_private
from prdp_torch.calls import between_graphs
from prdp_torch.kept_objects import Kept
from prdp_torch.solve import AdjointLog
from prdp_torch.solvers import (
    GMRES,
    PackedOptions,
    Preconditioner,
    Solver,
    check_options,
    check_settings,
    check_solver,
    packed_options,
    solve_options,
    tensors_of,
)
from prdp_torch.types import Backward, CheckpointEvery, OnFailure, Start

# What may be set on a stepper at any time: as properties, and as plain attributes.
PROPERTIES = ("max_iter", "rtol", "adjoint_rtol", "start")
PLAIN = ("restart", "preconditioner", "backward", "adjoint_max_iter", "on_failure", "checkpoint_every")
SETTINGS = (*PROPERTIES, *PLAIN)


class HasSettings(torch_private.HearsOfMoves):
    """A module with the settings of its solves: those of a solver, and the options that `Stepper` describes. They may
    be set at any time, and are checked then."""

    method: str
    restart: int
    preconditioner: Preconditioner
    backward: Backward
    adjoint_max_iter: int | None
    on_failure: OnFailure
    checkpoint_every: CheckpointEvery

    def __init__(
        self,
        solver: Solver,
        backward: Backward,
        adjoint_max_iter: int | None,
        adjoint_rtol: float | None,
        on_failure: OnFailure,
        checkpoint_every: CheckpointEvery,
        start: Start,
    ) -> None:
        super().__init__()
        who = type(self).__name__
        check_options(who, solver, backward, adjoint_max_iter, adjoint_rtol, on_failure, checkpoint_every, start)
        self.method = solver.method
        self._rtol = float(solver.rtol)
        self.restart = solver.restart
        self.preconditioner = solver.preconditioner
        self.backward = backward
        self.adjoint_max_iter = adjoint_max_iter
        self._adjoint_rtol = adjoint_rtol
        self._keep_bits()
        self.on_failure = on_failure
        self.checkpoint_every = checkpoint_every
        self.start = start
        self._max_iter = int(solver.max_iter)
        self._kept_options = Kept(solve_options)  # from here on, plain attributes are checked

    if not TYPE_CHECKING:

        def __setattr__(self, name: str, value: object) -> None:
            if not torch.compiler.is_compiling():
                if isinstance(getattr(type(self), name, None), property):
                    object.__setattr__(self, name, value)  # past Module, which would register a Parameter
                    return
                if name in PLAIN and "_kept_options" in self.__dict__:
                    self._check_settings(**{name: value})
                elif name not in self.__dict__ and (meant := _meant_setting(type(self), name)):
                    raise AttributeError(f"{type(self).__name__}: {meant}")
            super().__setattr__(name, value)

    def _moved(self, move: Callable[[Tensor], Tensor]) -> None:
        """A preconditioner goes with the step. It is no state: it changes how fast a solve is, not what it solves."""
        inverse = self.preconditioner
        if isinstance(inverse, operators.Operator):
            with torch.no_grad():
                tensors = [move(t) for t in inverse.tensors]
            if not all(map(is_, tensors, inverse.tensors)):
                self.preconditioner = inverse.of(tensors)

    def _check_settings(self, **changed: Any) -> None:
        """Raise ValueError or TypeError unless the solver and the options fit together with what is changed."""
        settings = {name: getattr(self, name) for name in SETTINGS} | changed
        check_settings(type(self).__name__, self.method, **settings)

    def _options_kept(self) -> _C.SolveOptions:
        """The options as the compiled library takes them past the dispatcher."""
        solver = self.method, self._rtol, self.restart, self.preconditioner, tensors_of(self.preconditioner)
        return self._kept_options.of(*solver, *self._settings())

    def _packed_options(self, log: AdjointLog) -> PackedOptions:
        """The options as the ops of torch take them."""
        if not torch.compiler.is_dynamo_compiling():
            k, m, settings = self._max_iter, self.preconditioner, self._settings()
            return packed_options(self.method, k, self._rtol, self.restart, m, *settings, adjoint_log=log.number)
        k = torch_private.number_as_graph_input(self, "_max_iter")
        rtol = torch_private.number_as_graph_input(self, "_rtol_bits")
        of_adjoint = torch_private.number_as_graph_input(self, "_adjoint_rtol_bits")
        k_of_adjoint = torch_private.number_as_graph_input(self, "adjoint_max_iter")
        return packed_options(
            self.method,
            k,
            0.0,
            self.restart,
            self.preconditioner,
            self.backward,
            adjoint_max_iter=k_of_adjoint,
            on_failure=self.on_failure,
            checkpoint_every=self.checkpoint_every,
            start=self.start,
            adjoint_log=log.number_in_graph(),
            rtol_bits=rtol,
            adjoint_rtol_bits=of_adjoint,
        )

    def _keep_bits(self) -> None:
        """The tolerances as compiled graphs take them."""
        self._rtol_bits = _bits_of(self._rtol)
        self._adjoint_rtol_bits = _bits_of(self._rtol if self._adjoint_rtol is None else self._adjoint_rtol)

    def _settings(self) -> tuple[Backward, int | None, float | None, OnFailure, CheckpointEvery, Start]:
        others = self.on_failure, self.checkpoint_every, self.start
        return self.backward, self.adjoint_max_iter, self._adjoint_rtol, *others

    @property
    def max_iter(self) -> int:
        return self._max_iter

    @max_iter.setter
    @between_graphs
    def max_iter(self, k: int) -> None:
        who = type(self).__name__
        k = _check.whole(who, "max_iter", k)
        check_solver(who, self.method, k, self.rtol, self.restart, self.preconditioner)
        self._max_iter = k

    @property
    def rtol(self) -> float:
        return self._rtol

    @rtol.setter
    @between_graphs
    def rtol(self, rtol: float) -> None:
        who = type(self).__name__
        rtol = _check.real(who, "rtol", rtol)
        check_solver(who, "gmres", 1, rtol, 1, None)
        self._rtol = rtol
        self._keep_bits()

    @property
    def adjoint_rtol(self) -> float | None:
        return self._adjoint_rtol

    @adjoint_rtol.setter
    @between_graphs
    def adjoint_rtol(self, rtol: float | None) -> None:
        check_options(type(self).__name__, GMRES(1), "implicit", None, rtol, "raise", None)
        self._adjoint_rtol = rtol
        self._keep_bits()

    @property
    def start(self) -> Start:
        return self._start

    @start.setter
    def start(self, start: Start) -> None:
        _C.check_start(_check.string(type(self).__name__, "start", start))
        self._start: Start = start

    def extra_repr(self) -> str:
        by = (
            ""
            if self.preconditioner is None or self.method == "multigrid"
            else f", preconditioner={self.preconditioner!r}"
        )
        return f"solver={self.method}{by}, max_iter={self.max_iter}, rtol={self.rtol:g}, backward={self.backward}"


def _bits_of(number: float) -> int:
    """The integer with the bits of a number in float64; of a tolerance, it is not negative."""
    bits: int = struct.unpack("<q", struct.pack("<d", number))[0]
    return bits


@functools.cache
def _meant_setting(kind: type[HasSettings], name: str) -> str | None:
    """What to say of a new attribute that must be meant for a setting, which would stay as it is. Classes outside this
    library may have attributes of any name."""
    if name.startswith("_") or name in SETTINGS or not kind.__module__.startswith("prdp_torch."):
        return None
    if name == "solver":
        return "the solver cannot be set later; max_iter, rtol, restart and preconditioner can"
    meant = difflib.get_close_matches(name, SETTINGS, n=1, cutoff=0.85)
    return f"no setting '{name}'; did you mean '{meant[0]}'?" if meant else None
