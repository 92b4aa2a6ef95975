"""How one run of a sweep is done. Imports no figures."""

from __future__ import annotations

from functools import partial

from dtsa_agent.core.plugins.entry_points import plug_ins_named
from dtsa_bench.experiments.batch.code import code_digest
from dtsa_bench.experiments.batch.task import Row, Task, Work, attempt

from .spec import Sweep, run_config


def work_of(sweep: Sweep) -> Work:
    """How the runs of a sweep are done; its code is that of the plug-ins, too, which the sweep names.

    :param sweep: the sweep.
    """
    named = {named for cell in sweep.cells for named in plug_ins_named(cell.run(sweep.seeds[0]).swarm)}
    return Work(fly_one, partial(code_digest, frozenset(named)))


def fly_one(task: Task) -> Row:
    """Flies one run.

    :param task: the run.
    :returns: its row; what goes wrong becomes the reason in it.
    """
    return attempt(task, _fly)


def _fly(task: Task) -> tuple[str, Row]:
    from dtsa_bench.simulation.simulate import simulate

    summary = simulate(run_config(task.settings)).summary()
    return summary["end"], summary
