"""Passes that are drawn elsewhere, many at a time, points by points."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from tqdm import tqdm

from ...estimation.image_estimate import ImageEstimate
from ...estimation.passes import Passes, Target
from ...host.clock import Run, Stopwatch
from ...machines.inline import Inline
from ...output.checkpoint import Checkpoint
from ...points.arrays import PointArrays
from ...sampling.problem import Problem
from ...scene.load import Scene
from ...settings.options import Machine
from .carrier import Carrier


class CarriedPasses(Passes):
    """As `Passes`, drawn by a `Carrier`.

    Passes between which nothing is asked are one step. A task draws a step of some points; what comes
    back is put where it belongs, so its order does not matter. A step that is ended early leaves some
    points ahead of others (`ImageEstimate.ahead`).

    Parameters
    ----------
    carrier : Carrier
    image_estimate : ImageEstimate
    problem, targets, edges, watch
        As `Passes` takes them.
    """

    def __init__(
        self,
        carrier: Carrier,
        image_estimate: ImageEstimate,
        problem: Problem,
        targets: list[Target],
        edges: Sequence[int],
        watch: Stopwatch,
    ) -> None:
        self._carrier, self._image_estimate = carrier, image_estimate
        self._problem, self._targets, self._watch = problem, targets, watch
        self.edges = edges

    def run(
        self,
        label: str,
        progress: bool = False,
        enough: Callable[[int], bool] | None = None,
        first: int = 0,
        last: int | None = None,
    ) -> int:
        """As `Passes.run`; `enough` is asked after each step. `stopped`: whether one was ended early."""
        last = self.number if last is None else min(last, self.number)
        done, apart = first, self._carrier.is_apart(self._problem)
        self.stopped = False
        share = (self.edges[last] - self.edges[first]) / self.edges[-1]
        total = round(share * sum(target.allocation.samples for target in self._targets))
        disable = None if progress else True
        with tqdm(total=total, unit="sample", unit_scale=True, desc=label, disable=disable) as bar:
            while done < last:
                end = self._carrier.step_end(done, last, apart)
                if self._image_estimate.ahead is not None:
                    end = self._image_estimate.ahead_to
                if not self._step(done, end, apart, bar):
                    self.stopped = True
                    return done
                done = end
                if enough is not None and enough(done):
                    return done
        return done

    def _step(self, first: int, last: int, apart: bool, bar: tqdm) -> bool:
        """Draw a step; False if it was ended early."""
        carrier, estimate = self._carrier, self._image_estimate
        source, before = self._problem.source, estimate.samples
        found = carrier.results(estimate, self._targets, self.edges, apart, (first, last))
        try:
            for points, result in found:
                estimate.keep_tile(points, result.states, result.means)
                source.rays += result.rays
                for stage, seconds in result.seconds.items():
                    self._watch.add(stage, seconds)
                bar.set_postfix(workers=len(carrier.crew.workers), refresh=False)
                bar.update(int(estimate.samples - before))
                before = estimate.samples
                carrier.save_now_and_then()
        except BaseException:
            # Whatever ends the render, what was done is kept.
            carrier.save_now()
            raise
        if carrier.crew.stopped:
            carrier.save_now()
            return False
        estimate.end_step()
        return True


@contextlib.contextmanager
def carried(
    problem: Problem,
    machine: Machine,
    run: Run,
    scene: Scene | None = None,
    given: PointArrays | None = None,
    resumed: Checkpoint | None = None,
) -> Iterator[Problem]:
    """The problem with a `Carrier`, while its samples are drawn, if there are workers.

    Parameters
    ----------
    resumed : Checkpoint, optional
        One that was written between two tasks goes on by tasks, with or without workers.
    """
    executor = machine.executor
    if executor is None and resumed is not None and resumed.is_between_tasks:
        executor = Inline()
    if executor is None or not problem.points.active:
        yield problem
        return
    carrier = Carrier(executor, machine, run, problem, scene, given)
    carrier.passes = functools.partial(CarriedPasses, carrier)
    try:
        yield replace(problem, carrier=carrier)
    finally:
        carrier.close()
