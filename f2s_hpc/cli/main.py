"""The ``f2s`` command: parse, call, report, exit code."""

from __future__ import annotations

import argparse
import io
import os
import pathlib
import sys
import time
from collections.abc import Sequence
from typing import NoReturn, TextIO

from f2s_hpc import one_rank, places
from f2s_hpc.cli import measuring
from f2s_hpc.errors import F2SError, InputError

SIGPIPE_CODE = 128 + 13
"""What shells give for a program that a closed pipe ended (Windows does not know the signal by name)."""


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, and that speaks on rank 0 only."""

    def parse_known_args(self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None):
        """Parse as ever, but let the command itself, not ``f2s``, tell of a word that it does not know."""
        parsed, unknown = super().parse_known_args(args, namespace)
        if unknown:
            spaces = "; write KEY=VALUE without spaces around =" if unknown[0].startswith("=") else ""
            self.error(f"unrecognized arguments: {' '.join(unknown)}{spaces}")
        return parsed, unknown

    def error(self, message: str) -> NoReturn:
        self.exit(InputError.exit_code, f"{self.prog}: {message}; '{self.prog} --help' tells what is possible\n")

    def _print_message(self, message: str, file: TextIO | None = None) -> None:
        if _speaks():
            super()._print_message(message, file)


class _Version(argparse.Action):
    """Prints the version, which only who asks for it needs to look up."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from f2s_hpc.origin import version_text
        parser._print_message(f"f2s {version_text()}\n", sys.stdout)
        parser.exit()


def _speaks() -> bool:
    """Tell whether this is rank 0, also where MPI does not load, as ``f2s doctor`` must be able to say."""
    try:
        from f2s_hpc import mpi
    except (ImportError, OSError, RuntimeError, F2SError):
        return one_rank.launched_rank() == 0
    return mpi.is_root()


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="f2s", description="Simulate cold-spray deposition: batches of particles hit a substrate and deform.",
        epilog="To begin: 'f2s scenes' lists what can be run, 'f2s check SCENE' tells what it takes, 'mpirun -n 2 f2s "
               "run SCENE' runs it, 'f2s report DIR' measures what came out. 'f2s COMMAND --help' tells more of each.")
    parser.add_argument("--version", action=_Version, nargs=0, help="show version and commit, and exit")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, text: str) -> argparse.ArgumentParser:
        return commands.add_parser(name, help=text, description=text)

    def scene_arguments(sub: argparse.ArgumentParser) -> None:
        sub.add_argument("scene", metavar="SCENE", help="name of a built-in scene, or a TOML file")
        sub.add_argument("--set", dest="overrides", metavar="KEY=VALUE", action="append", default=[],
                         help='replace one value of the scene, e.g. --set domain.cell_size="6 um"')

    sub = command("scenes", "list the built-in scenes, print one as TOML to edit, or tell all keys of a scene")
    sub.add_argument("name", nargs="?", metavar="NAME", help="print this scene")
    sub.add_argument("--keys", nargs="?", const="", metavar="SECTION|KEY",
                     help="print all keys of a scene, of one section, or one key: meaning, values, default")
    sub = command("materials", "list the materials of the library, or print one as TOML to edit")
    sub.add_argument("name", nargs="?", metavar="NAME", help="print the [material] section of this one")
    scene_arguments(command("check", "validate a scene and say what running it will take"))
    sub = command("plan", "predict time, memory and efficiency of a scene on any number of ranks")
    scene_arguments(sub)
    sub.add_argument("--ranks", metavar="N[,N..]",
                     help="numbers of ranks (those of 1,2,4,16,64 into which the box can be cut)")
    sub.add_argument("--rates", metavar="FILE",
                     help="measured rates of the step; if FILE is not there they are measured and written to it")
    sub.add_argument("--latency", default="2 us", metavar="TIME", help='of a message between ranks ("2 us")')
    sub.add_argument("--bandwidth", type=float, default=5.0, metavar="GB/S", help="of a rank's messages, GB/s (5)")
    sub.add_argument("--check", action="store_true",
                     help="run the start of the scene on 1 and 2 ranks and print predicted over measured")
    sub.add_argument("--check-time", metavar="TIME", help="simulated time of --check (40 steps)")
    sub.add_argument("--json", metavar="FILE", help="write the predictions as JSON")
    sub = command("run", "run a scene (alone or under mpirun)")
    scene_arguments(sub)
    sub.add_argument("--out", metavar="DIR", help="new folder for the results (default: runs/<scene>)")
    sub = command("resume", "continue a run from its newest valid checkpoint, on any number of ranks")
    sub.add_argument("folder", metavar="DIR", help="folder of a run")
    sub.add_argument("--set", dest="overrides", metavar="KEY=VALUE", action="append", default=[],
                     help="replace a value of the run or output section, or cycles.count: more cycles, or fewer")
    sub = command("particles", "write the batches of a scene as CSV files")
    scene_arguments(sub)
    sub.add_argument("--out", metavar="DIR", required=True, help="new or empty folder for them, and for a picture")
    _stream_arguments(command)
    sub = command("inspect", "print how a run stands, also while it goes on, and its cycle table")
    sub.add_argument("folder", metavar="DIR", help="folder of a run")
    measuring.add_commands(command)
    _verify_arguments(command("verify", "measure the solver against known solutions, and judge it by its bars"))
    command("doctor", "tell what is installed, and write and read a file on two ranks")
    return parser


def _stream_arguments(command) -> None:
    # argparse reads these only: the modules behind them must not be needed to start
    from f2s_hpc.cli import stream_options
    stream_options.stream(command("stream", "fit the particle stream to particles measured in flight"))
    stream_options.feed(command("feed", "tell how many particles hit the strip at a scanning speed"))


def _verify_arguments(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("cases", nargs="*", metavar="CASE", help="names of cases (default: all)")
    sub.add_argument("--list", action="store_true", help="list the cases and their settings, run nothing")
    sub.add_argument("--full", action="store_true", help="full sizes instead of quick ones")
    sub.add_argument("--set", dest="overrides", metavar="NAME=VALUE", action="append", default=[],
                     help="replace a setting of the cases that have it, e.g. --set resolutions=16,32,64")
    sub.add_argument("--json", metavar="FILE", help="write all rows as one JSON list")
    sub.add_argument("--out", metavar="DIR", default="verification",
                     help="folder for tables and plots (default: verification)")
    sub.add_argument("--extreme", action="store_true",
                     help="instead of the cases: extreme scenes and random ones, each with a verdict")
    sub.add_argument("--fuzz", metavar="N", type=int, help="number of random scenes of --extreme (8; 300 with --full)")
    sub.add_argument("--seed", metavar="N", type=int, help="seed of the random scenes of --extreme (1)")
    sub.add_argument("--levers", action="store_true",
                     help="instead of the cases: what leaving out saves, and what it changes")


def _scenes(arguments: argparse.Namespace) -> int:
    from f2s_hpc import mpi
    from f2s_hpc.config import key_reference, load_scene, scene_names, scene_text
    if arguments.keys is not None:
        if arguments.name:
            raise InputError("f2s scenes: a scene or --keys, one after the other, not both")
        text = f"{key_reference(arguments.keys)}\n"
    else:
        text = (scene_text(arguments.name) if arguments.name else
                "".join(f"{name:20s} {load_scene(name).title}\n" for name in scene_names()))
    if mpi.is_root():
        print(text, end="")
    return 0


def _materials(arguments: argparse.Namespace) -> int:
    from f2s_hpc import mpi
    from f2s_hpc.config import material_list, material_text
    text = material_text(arguments.name) if arguments.name else material_list()
    if mpi.is_root():
        print(text)
    return 0


def _check(arguments: argparse.Namespace) -> int:
    from f2s_hpc import mpi
    from f2s_hpc.cli import tasks
    scene = tasks.load(arguments.scene, arguments.overrides)
    text = tasks.check(scene)
    if mpi.is_root():
        print(text)
    return 0


def _plan(arguments: argparse.Namespace) -> int:
    from f2s_hpc.cli import needs
    needs.solver("plan")
    from f2s_hpc.cli import plan
    return plan.run(arguments)


def _run(arguments: argparse.Namespace) -> int:
    from f2s_hpc.cli import needs, tasks
    needs.solver("run")
    needs.ranks_together("run")
    scene = tasks.load(arguments.scene, arguments.overrides)
    if arguments.out == "":
        raise InputError("--out: names no folder; is a variable empty? leave it out for runs/<scene>")
    out = arguments.out or str(pathlib.Path("runs") / pathlib.Path(arguments.scene).stem)
    return tasks.run(scene, out, arguments.started)


def _resume(arguments: argparse.Namespace) -> int:
    from f2s_hpc.cli import needs, tasks
    needs.solver("resume")
    needs.ranks_together("resume")
    return tasks.resume(arguments.folder, arguments.overrides, arguments.started)


def _particles(arguments: argparse.Namespace) -> int:
    from f2s_hpc.cli import tasks
    return tasks.write_particles(tasks.load(arguments.scene, arguments.overrides), arguments.out)


def _stream(arguments: argparse.Namespace) -> int:
    from f2s_hpc.cli import stream
    return stream.stream(arguments)


def _feed(arguments: argparse.Namespace) -> int:
    from f2s_hpc.cli import stream
    return stream.feed(arguments)


def _inspect(arguments: argparse.Namespace) -> int:
    from f2s_hpc.cli import tasks
    return tasks.inspect(arguments.folder)


def _verify(arguments: argparse.Namespace) -> int:
    from f2s_hpc import mpi
    from f2s_hpc.cli import needs
    from f2s_hpc.verify import suite
    if arguments.list:
        if mpi.is_root():
            print(suite.list_cases())
        return 0
    needs.solver("verify")
    if (arguments.extreme or arguments.levers) and arguments.cases:
        raise InputError("f2s verify: name cases, or ask for --extreme or --levers, not both")
    if arguments.extreme and arguments.levers:
        raise InputError("f2s verify: --extreme or --levers, one after the other, not both")
    if arguments.fuzz is not None and (arguments.fuzz < 0 or not arguments.extreme):
        raise InputError("f2s verify: --fuzz N goes with --extreme, N at least 0")
    if arguments.seed is not None and (arguments.seed < 0 or not arguments.extreme):
        raise InputError("f2s verify: --seed N goes with --extreme, N at least 0")
    if arguments.extreme or arguments.levers:
        from f2s_hpc.verify import reports
        if arguments.levers:
            return reports.savings(arguments.full, arguments.overrides, arguments.json)
        seed = 1 if arguments.seed is None else arguments.seed
        return reports.stability(arguments.full, arguments.overrides, arguments.fuzz, seed, arguments.json)
    return suite.verify(arguments.cases, arguments.overrides, arguments.full, arguments.out, arguments.json)


def _doctor(arguments: argparse.Namespace) -> int:
    from f2s_hpc.doctor import run_doctor
    return run_doctor(sys.stdout)


_COMMANDS = {"scenes": _scenes, "materials": _materials, "check": _check, "plan": _plan, "run": _run,
             "resume": _resume, "particles": _particles, "stream": _stream, "feed": _feed, "inspect": _inspect,
             "analyse": measuring.analyse, "compare": measuring.compare, "report": measuring.report,
             "export": measuring.export, "verify": _verify}


def main(arguments: list[str]) -> int:
    """Run one command; return its exit code. A user's error is one line on standard error, from rank 0 only."""
    # (what is imported and set up from here on counts for a run's wall time)
    parsed = _parser().parse_args(arguments, argparse.Namespace(started=time.monotonic()))
    if parsed.command == "doctor":
        # tells what is missing, so it must start where the rest can not
        return _doctor(parsed)
    try:
        from f2s_hpc import mpi
    except F2SError as error:
        return _told(error)
    except (ImportError, OSError, RuntimeError) as error:
        return _told(InputError(f"f2s does not start: {_line(error)}; 'f2s doctor' tells what is missing or broken, "
                                "and how to mend it"))
    mpi.install_abort_hook()
    try:
        code = _COMMANDS[parsed.command](parsed)
        sys.stdout.flush()
        return code
    except F2SError as error:
        return _told(error)
    except (OSError, MemoryError) as error:
        if mpi.size() > 1:  # (the other ranks may wait for this one: the hook ends them all)
            raise
        return _left_alone() if isinstance(error, BrokenPipeError) else _told(places.refused(error))
    except ModuleNotFoundError as error:
        if mpi.size() > 1 or str(error.name).startswith("f2s_hpc"):
            raise
        return _told(InputError(f"{error.name} is not installed; 'f2s doctor' tells what else is missing, and how to "
                                "get it"))
    finally:
        if "f2s_hpc.grid.halo" in sys.modules and sys.exc_info()[0] is None:
            sys.modules["f2s_hpc.grid.halo"].release_all()


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _told(error: F2SError) -> int:
    """Print the one line about an error on rank 0; return the exit code."""
    if _speaks():
        prefix = "" if isinstance(error, InputError) else "f2s: "
        sys.stdout.flush()
        print(f"{prefix}{error}", file=sys.stderr, flush=True)
    return error.exit_code


def _left_alone() -> int:
    """Print no more, as what reads the output (head, less) has ended; return the exit code that shells give for it."""
    from f2s_hpc.cycles.progress import silence
    silence()
    return SIGPIPE_CODE


def entry() -> None:
    """Entry point of the ``f2s`` command."""
    for stream in (sys.stdout, sys.stderr):
        # (a terminal without Greek letters and arrows shows ? for them)
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    code = main(sys.argv[1:])
    if "f2s_hpc.io.layout" in sys.modules and sys.modules["f2s_hpc.io.layout"].unclosed():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)  # (HDF5 must not try again)
    sys.exit(code)
