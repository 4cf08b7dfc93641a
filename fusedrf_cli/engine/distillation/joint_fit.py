"""Fits of several fields that have a part of their numbers in common: a decoder that all of them learn
(Control-NeRF, Lazova et al., WACV 2023)."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext

import numpy as np
import torch

from fusedrf_cli.engine.distillation.fit import FitRun, part_of
from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.kernels import working_time
from fusedrf_cli.engine.kinds import registry


class JointFit:
    """Runs that take turns: the one that is least far on makes the next step, and all others take its shared
    part. So every run keeps the schedule that it has alone, and all end together."""

    def __init__(self, runs: Sequence[FitRun]):
        """runs: before their first step, of one kind with a `shared_part` of one shape. The time budget of
        each is its own: its clock stands still while others learn."""
        self.runs = list(runs)
        self.kind = registry.kind(self.runs[0].config.kind)
        now = working_time()
        for run in self.runs:
            run.started = now
        self.hand_on(self.runs[0])

    def shared(self, run: FitRun) -> list[torch.Tensor]:
        """Views of a run's numbers that all have in common."""
        sections = run.field.sections().items()
        return [view for name, view in sections if name.startswith(f"{self.kind.shared_part}.")]

    def hand_on(self, run: FitRun) -> None:
        """Give all other runs the shared part that one has, also where its guard went back to an earlier
        one."""
        for other in self.runs:
            if other is not run:
                for own, learnt in zip(self.shared(other), self.shared(run), strict=True):
                    own.copy_(learnt)
                other.field.settle()

    def next(self) -> FitRun | None:
        """The run whose turn it is; None where all are done, or have reached the PSNR that they were asked
        for: one that has goes on while others have not, since the shared part changes under it."""
        waiting = [run for run in self.runs if run.share() < 1.0]
        if all(run.reached() for run in self.runs):
            return None
        return min(waiting, key=FitRun.share, default=None)

    def turn(self, run: FitRun) -> None:
        """One step of a run."""
        began = working_time()
        run.turn(run.share())
        self.hand_on(run)
        taken = working_time() - began
        for other in self.runs:
            if other is not run:
                other.started += taken

    def finish(
        self,
        advance: Callable[[float, dict], None] = lambda share, figures: None,
        uninterrupted: Callable[[], AbstractContextManager] = nullcontext,
    ) -> list[StoredField]:
        """Run all to the end; see `FitRun.finish`. The fields, whose shared part learns no further."""
        while (run := self.next()) is not None:
            with uninterrupted():
                self.turn(run)
            if sum(run.steps for run in self.runs) % 20 == 0:
                advance(float(np.mean([run.share() for run in self.runs])), {"psnr": self.psnr})
        for run in self.runs:
            with uninterrupted():
                run.end()
                self.hand_on(run)
        return [self.kind.sharing(run.field) for run in self.runs]

    @property
    def psnr(self) -> float:
        """That of the run whose training rays show least, dB."""
        return min(run.psnr for run in self.runs)

    def checkpoint(self) -> tuple[dict[str, np.ndarray], dict]:
        """See FitRun: arrays begin with the number of their run."""
        return self._joined([run.checkpoint() for run in self.runs])

    @property
    def held(self) -> tuple[dict[str, np.ndarray], dict] | None:
        """See FitRun."""
        if all(run.held is None for run in self.runs):
            return None
        return self._joined([run.held or run.checkpoint() for run in self.runs])

    def _joined(self, saved: Sequence[tuple[dict[str, np.ndarray], dict]]) -> tuple[dict, dict]:
        arrays = {f"{i}.{name}": array for i, (own, _) in enumerate(saved) for name, array in own.items()}
        states = {str(i): state for i, (_, state) in enumerate(saved)}
        return arrays, {"command": "train", "kind": self.kind.name, "runs": states}

    def restore(self, arrays: dict[str, np.ndarray], state: dict) -> None:
        """See FitRun."""
        if len(state["runs"]) != len(self.runs):
            raise ValueError(f"{len(state['runs'])} runs, expected {len(self.runs)}")
        for i, run in enumerate(self.runs):
            run.restore(part_of(arrays, f"{i}."), state["runs"][str(i)])
