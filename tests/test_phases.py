"""Where a run's time goes: the phases in summary.json, in f2s inspect and in PETSc's log."""

from __future__ import annotations

import json
import pathlib
import re
from types import SimpleNamespace

import pytest
from conftest import F2S, f2s, launch
from test_cli import SCENE

from f2s_hpc import mpi, phases
from f2s_hpc.analysis.table import where_the_time_went
from f2s_hpc.cli.main import main
from f2s_hpc.cycles.spent import Spent
from f2s_hpc.errors import InputError
from f2s_hpc.grid import log
from f2s_hpc.io import runs

REQUEUE = 75
STEPS = ("activity", "forces", "nodes", "deformation", "conduction", "remap")


def total(summary: dict, of: str = "mean_s") -> float:
    return sum(entry[of] for entry in summary["phases"].values())


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> tuple[pathlib.Path, str]:
    """Return the folder of a run on 2 ranks with PETSc's log, and what it printed."""
    folder = tmp_path_factory.mktemp("phases")
    (folder / "two.toml").write_text(SCENE.replace('"15 ns"', '"40 ns"'), encoding="utf-8")
    done = launch([*F2S, "run", "two.toml", "--out", "logged"], 2, folder, environment={"PETSC_OPTIONS": "-log_view"})
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "logged", done.stdout


@pytest.fixture(scope="module")
def resumed(logged: tuple[pathlib.Path, str]) -> tuple[dict, dict, pathlib.Path]:
    """Return the summaries of a run on one rank, stopped after its first step and resumed, and its folder."""
    folder = logged[0].parent
    f2s("run", "two.toml", "--out", "resumed", "--set", "run.wall_time=1 ms", cwd=folder, code=REQUEUE)
    stopped = runs.read_summary(folder / "resumed")
    f2s("resume", "resumed", "--set", "run.wall_time=1 h", cwd=folder)
    return stopped, runs.read_summary(folder / "resumed"), folder / "resumed"


def test_the_phases_of_all_sessions_add_up_to_the_wall_time(resumed):
    """Fails if ``Spent.restore`` forgets those of before, or ``phases.started`` what the first step took."""
    stopped, summary, _ = resumed
    for found in resumed[:2]:
        assert list(found["phases"]) == list(phases.PHASES)
        assert total(found) == pytest.approx(found["wall_s"], rel=0.2)  # (two clocks, on a machine that may be busy)
        assert total(found) == total(found, "largest_s")  # (one rank)
    assert stopped["phases"]["remap"] == {"mean_s": 0.0, "largest_s": 0.0}
    assert 0.0 < stopped["phases"]["startup"]["mean_s"] <= stopped["startup_s"]
    assert summary["phases"]["startup"]["mean_s"] > stopped["phases"]["startup"]["mean_s"]
    assert all(summary["phases"][name]["mean_s"] > 0.0 for name in (*STEPS, "particles", "measuring", "output"))


def test_what_is_written_after_the_last_row_is_in_the_summary(resumed):
    """Fails if the summary takes its phases and wall time from the row: frame and checkpoint come after it."""
    _, summary, folder = resumed
    row = runs.read_cycle_table(folder)[-1]
    assert float(row["wall_s"]) < summary["wall_s"]
    assert float(row["phases_output_mean_s"]) < summary["phases"]["output"]["mean_s"]
    assert set(row) >= {f"phases_{name}_{of}" for name in phases.PHASES for of in ("mean_s", "largest_s")}
    assert summary["active_cell_steps_per_s"] == pytest.approx(summary["active_cell_steps"] / summary["wall_s"])


def test_the_phases_are_no_result(logged, resumed):
    """Fails without ``phases.*`` in ``NOT_A_RESULT``: no two runs take the same time."""
    said = f2s("compare", logged[0], resumed[2], "--exact", cwd=logged[0].parent).stdout
    assert "identical in every saved bit" in said


def test_petscs_log_shows_the_same_phases(logged):
    """Fails if the stages follow the phases from the start on: the first step compiles or loads the kernels."""
    folder, said = logged
    stages = {name: float(seconds) for name, seconds in
              re.findall(r"^ *\d+: +(\w+): ([0-9.e+-]+) ", said.partition("Summary of Stages")[2], re.MULTILINE)}
    summary = runs.read_summary(folder)
    assert set(stages) >= {"startup", *STEPS, "particles", "ghosts", "reductions", "measuring", "output", "other"}
    # two clocks, on a machine that may be busy
    for name in ("startup", "remap"):
        assert stages[name] == pytest.approx(summary["phases"][name]["mean_s"], rel=0.5), name
    assert total(summary) == pytest.approx(summary["wall_s"], rel=0.2)
    assert summary["phases"]["reductions"]["mean_s"] > 0.0
    assert all(entry["mean_s"] <= entry["largest_s"] for entry in summary["phases"].values())


def test_nothing_is_logged_unasked(resumed):
    """Fails if ``log.stages`` does not ask whether PETSc logs: then it costs a call for each phase."""
    done = launch([F2S[0], "-c", "from f2s_hpc.grid import decomposition, log; print(log.stages())"],
                  1, resumed[2], environment={"PETSC_OPTIONS": ""})
    assert done.stdout == "None\n", done.stderr


def test_inspect_says_where_the_time_went(capsys, logged):
    """Fails if the phases stay in summary.json."""
    assert main(["inspect", str(logged[0])]) == 0
    line = capsys.readouterr().out.splitlines()[1]
    whole = re.match(r"where the time went, ([0-9.]+) s: ", line)
    assert whole
    summary = runs.read_summary(logged[0])
    assert float(whole[1]) == pytest.approx(total(summary), rel=1e-3)
    shares = [int(n) for n in re.findall(r"(\d+) %", line)]
    assert shares == sorted(shares, reverse=True)
    assert 90 < sum(shares) < 110
    assert re.search(r"\bstartup \d+ %", line)


def test_the_largest_on_a_rank_is_told_where_it_is_more():
    """Fails if only the mean is printed, by which nobody sees that one rank waits for the other."""
    found = {"remap": {"mean_s": 6.0, "largest_s": 6.01}, "ghosts": {"mean_s": 3.0, "largest_s": 5.0},
             "other": {"mean_s": 1.0, "largest_s": 1.0}, "tracers": {"mean_s": 0.0, "largest_s": 0.0}}
    assert where_the_time_went(found) == "where the time went, 10 s: remap 60 %, ghosts 30 % (up to 50), other 10 %"
    assert where_the_time_went({}).endswith(": -")


@pytest.mark.parametrize("wrong", [[], {"remap": 3.0}, {"remap": {"mean_s": 1.0}},
                                   {"remap": {"mean_s": 1.0, "largest_s": "x"}}])
def test_inspect_refuses_phases_that_are_none(capsys, tmp_path, wrong):
    """Fails with a traceback if they are taken without a look."""
    with pytest.raises(InputError):
        where_the_time_went(wrong)
    summary = {"scene": "x", "status": "complete", "particles": 1, "ranks": 1, "phases": wrong}
    (tmp_path / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    assert main(["inspect", str(tmp_path)]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert len(err.splitlines()) == 1
    assert "summary.json: phases: must tell mean_s" in err


class HandClock:
    """A clock that goes on only when told, and what takes time by it."""

    def __init__(self) -> None:
        self.now = 0.0

    @phases.phase("remap")
    def remap(self, seconds: float, ghosts: float = 0.0, fails: bool = False) -> None:
        """Take ``seconds``, then ``ghosts`` seconds inside, then perhaps fail."""
        self.now += seconds
        if ghosts:
            self.ghosts(ghosts)
        if fails:
            raise InputError("as asked")

    @phases.phase("ghosts")
    def ghosts(self, seconds: float) -> None:
        """Take ``seconds``."""
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> HandClock:
    """Return the clock that the phases are told by."""
    hand = HandClock()
    monkeypatch.setattr(phases, "perf_counter", lambda: hand.now)
    return hand


def test_time_belongs_to_the_innermost_phase_also_after_an_error(clock):
    """Fails if a phase counts what is inside it twice, or is not left by an exception."""
    phases.start()
    clock.remap(2.0)
    entered = []
    phases.started(entered.append)
    clock.remap(2.0, ghosts=3.0)
    with pytest.raises(InputError):
        clock.remap(1.0, fails=True)
    clock.now += 0.5
    spent = {name: seconds for name, seconds in zip(phases.PHASES, phases.seconds()) if seconds}
    assert spent == {"startup": 2.0, "remap": 3.0, "ghosts": 3.0, "other": 0.5}
    names = [list(phases.PHASES)[number] for number in entered]
    assert names == ["remap", "ghosts", "remap", "other", "remap", "other", "other"]


def test_a_stage_of_petscs_log_ends_where_the_next_begins(monkeypatch):
    """Fails if a stage goes on that has ended: ``if phase > present`` in ``log.stages``; PETSc would count it twice."""
    under_way, entered = [], []

    class Stage:
        def __init__(self, name: str) -> None:
            self.name = name

        def push(self) -> None:
            under_way.append(self.name)
            entered.append(self.name)

        def pop(self) -> None:
            assert under_way.pop() == self.name

    monkeypatch.setattr(log.petsc, "load", lambda: SimpleNamespace(
        Log=SimpleNamespace(isActive=lambda: True, Stage=Stage)))
    enter = log.stages()
    order = ["remap", "ghosts", "remap", "remap", "forces", "startup"]
    for name in order:
        enter(list(phases.PHASES).index(name))
        assert under_way == [name]
    assert entered == ["startup", "remap", "ghosts", "remap", "forces", "startup"]


@pytest.mark.mpi
def test_all_ranks_know_mean_and_largest_of_all_sessions(clock):
    """Fails if a rank tells its own seconds, or the earlier session's are left out."""
    phases.start()
    phases.started()
    clock.remap(1.0 + mpi.rank())
    spent = Spent()
    now = spent.so_far(2.0)
    assert now["wall_s"] == 2.0
    assert mpi.all_gather(now) == [now] * mpi.size()
    remap = now["phases"]["remap"]
    assert remap == {"mean_s": (1.0 + mpi.size()) / 2.0, "largest_s": 1.0 * mpi.size()}
    later = Spent()
    later.restore(now)
    both = later.so_far(3.0)
    assert both["wall_s"] == 5.0
    assert both["phases"]["remap"] == {"mean_s": 2 * remap["mean_s"], "largest_s": 2 * remap["largest_s"]}


def test_what_an_older_checkpoint_spent_counts_as_other():
    """Fails if the phases then add up to less than the wall time."""
    phases.start()
    spent = Spent()
    spent.restore({"wall_s": 1000.0, "peak_memory_bytes": 5})
    found = spent.so_far(1.0)
    assert found["wall_s"] == 1001.0
    assert found["phases"]["other"]["mean_s"] >= 1000.0
    assert found["phases"]["remap"]["mean_s"] == 0.0
    assert found["peak_memory_bytes"] > 5
