"""Plants faults in copies of the package, one in each, and shows which of them the tests catch.

    python tests/planted_faults.py survey out=survey.jsonl jobs=2    which functions each test calls; once
    python tests/planted_faults.py list seed=1 count=100             the faults
    python tests/planted_faults.py run seed=1 count=100 jobs=2 survey=survey.jsonl out=planted.json

The tests that call the faulty function are tried from the nearest and fastest on: first as Python, without compiling,
then, where those pass, compiled. What fails counts as caught only if it passes without the fault. `out` is written
after each fault; the same command goes on where it was stopped. Other options: tests=nearest (Python only), default or
all (with the slow ones); interpreted=, longer=, compiled= seconds for each fault; stop= seconds for the whole run.

What cannot be tested for lack of a library is listed apart, as are faults that change nothing (an operand that is
always zero, a bound that no number meets), each with its reason in planted_equivalents.json.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from planted_mutations import Fault, draw
from planted_nearest import Chooser, Survey, test_files

ROOT = Path(__file__).resolve().parents[1]
EQUIVALENTS = Path(__file__).with_name("planted_equivalents.json")
COPIED = ("multilift_marl", "tests", "configs", "examples")
SUSPECTS = 2  # failures of this kind that end the trial as Python
INEXACT = ("ZeroDivisionError", "math domain error", "OverflowError", "math range error")  # other in compiled code
OPTIONS = {
    "seed": 1, "count": 100, "jobs": 2, "tests": "default", "survey": "survey.jsonl", "out": "planted.json",
    "interpreted": 30.0, "longer": 60.0, "compiled": 150.0, "stop": 1e9,
}  # fmt: skip


@dataclass
class Result:
    """What became of a fault."""

    status: str
    """caught, timed out, missed, unfinished, equivalent, or unreached: what its tests need is not installed."""
    stage: str = ""
    test: str = ""
    message: str = ""
    slow: bool = False
    ran: int = 0
    """Tests that passed with it."""
    seconds: float = 0.0


@dataclass
class Bench:
    """A folder of copies, and what is known of the package without faults."""

    folder: Path
    options: dict
    end: float
    sound: dict[tuple[str, bool], bool] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def copy(self, name: str) -> Path:
        """Return a new copy of the tree; what is large and not tested by itself is linked."""
        tree = self.folder / name
        tree.mkdir()
        for path in ROOT.iterdir():
            if path.name in COPIED:
                shutil.copytree(path, tree / path.name, ignore=shutil.ignore_patterns("__pycache__", "runs"))
            elif path.name != ".git":
                (tree / path.name).symlink_to(path)
        return tree

    def run(self, tree: Path, tests: list[str], compiled: bool, seconds: float, each: float, late: bool) -> list[dict]:
        """Return what the tests said, up to the first that failed; the last entry says how the run ended.

        Args:
            tree: copy of the package.
            tests: in their order.
            compiled: as kernels, or as Python.
            seconds: for all of them.
            each: for each [s].
            late: whether one that has no more time ends the run.
        """
        seconds = min(seconds, self.end - time.monotonic())
        if not tests or seconds <= 1:
            return [{"outcome": "unfinished" if tests else "finished", "test": ""}]
        report, names = tree / f"report-{time.monotonic_ns()}.jsonl", tree / f"names-{time.monotonic_ns()}.txt"
        names.write_text("\n".join(tests) + "\n", encoding="utf-8")
        environment = os.environ | {
            "PYTHONPATH": f"{tree}{os.pathsep}{tree / 'tests'}", "PLANTED_REPORT": str(report),
            "PLANTED_STOP_LATE": str(int(late)), "NUMBA_DISABLE_JIT": str(int(not compiled)),
            "NUMBA_CACHE_DIR": str(self.folder / "kernels"), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1",
            "PYTEST_XDIST_WORKER_COUNT": "999",  # no second process that compiles
        }  # fmt: skip
        command = [sys.executable, "-m", "pytest", "-q", "-m", "", "-p", "planted_report", "-p", "no:cacheprovider"]
        command += ["--tb=no", f"--timeout={each:g}", "--timeout-method=signal", f"@{names}"]
        process = subprocess.Popen(
            command, cwd=tree, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip
        try:
            code, ending = process.wait(seconds), "finished"
        except subprocess.TimeoutExpired:
            code, ending = 0, "unfinished"
        try:
            os.killpg(process.pid, signal.SIGKILL)  # and what its tests left behind
        except ProcessLookupError:
            pass
        process.wait()
        lines = report.read_text(encoding="utf-8").splitlines() if report.is_file() else []
        entries = [json.loads(line) for line in lines]
        if code not in (0, 1, 2, 5) or any(entry["outcome"] == "uncollected" for entry in entries):
            return [*entries, {"outcome": "broken", "test": "", "message": f"pytest ended with {code}"}]
        return [*entries, {"outcome": ending, "test": ""}]

    def is_sound(self, test: str, compiled: bool) -> bool:
        """Return whether a test passes without faults."""
        with self.lock:
            known = self.sound.get((test, compiled))
        if known is None:
            entries = self.run(self.folder / "sound", [test], compiled, 600, 300, True)
            known = any(entry["test"] == test and entry["outcome"] == "passed" for entry in entries)
            if entries[-1]["outcome"] == "unfinished":
                return False
            with self.lock:
                self.sound[test, compiled] = known
        return known


def _try(
    bench: Bench, tree: Path, tests: list[str], stage: str, seconds: float, result: Result, reached: set[str],
    suspects: list[str] | None,
) -> tuple[bool, bool]:  # fmt: skip
    """Run tests until one catches the fault; return whether it did, and whether all were run.

    Args:
        bench, tree, tests, stage, seconds: how.
        result: written.
        reached: tests that have passed are added.
        suspects: of a kernel, tests are added whose arithmetic is another if they are compiled.
    """
    compiled, late = stage == "compiled", stage == "interpreted"
    end = time.monotonic() + seconds
    rest = list(tests)
    while rest:
        each = {"interpreted": 60.0, "longer": 30.0, "compiled": 600.0}[stage]
        entries = bench.run(tree, rest, compiled, end - time.monotonic(), each, late)
        passed = {entry["test"] for entry in entries if entry["outcome"] == "passed"}
        result.ran += len(passed)
        reached |= passed
        ending = entries[-1]["outcome"]
        if ending == "broken":
            result.status, result.stage, result.message = "caught", "import", entries[-1]["message"]
            return True, True
        failed = [entry for entry in entries if entry["outcome"] in (("failed", "late") if late else ("failed",))]
        if not failed:
            return False, ending == "finished"
        name = failed[-1]["test"]
        inexact = not compiled and any(word in failed[-1]["message"] for word in INEXACT)
        if inexact and suspects is not None:
            suspects.append(name)
            if len(suspects) >= SUSPECTS:
                return False, False
        elif bench.is_sound(name, compiled):
            result.status = "timed out" if failed[-1]["outcome"] == "late" else "caught"
            result.stage, result.test, result.message = stage, name, failed[-1]["message"]
            return True, True
        done = {entry["test"] for entry in entries}
        rest = [test for test in rest if test not in done]
    return False, True


def examine(fault: Fault, bench: Bench, chooser: Chooser) -> Result:
    """Plant a fault in a copy and let tests look for it."""
    began, result, whole, reached = time.monotonic(), Result("missed"), True, set[str]()
    tree = bench.copy(fault.key)
    try:
        path = tree / "multilift_marl" / fault.file
        path.write_bytes(fault.planted(path.read_bytes()))
        choice = chooser.choose(fault, bench.options["interpreted"])
        suspects = list[str]() if fault.compiled else None
        stages = [("interpreted", choice.fast, 10 * bench.options["interpreted"] + 30)]
        stages.append(("longer", choice.stopped, bench.options["longer"]))
        if bench.options["tests"] != "nearest":
            stages.append(("compiled", choice.rest, bench.options["compiled"]))
        for stage, tests, seconds in stages:
            if stage == "longer" and suspects:
                continue
            if stage == "compiled" and suspects:  # what was given up as Python is tried too
                whole, left = True, [test for test in choice.fast if test not in reached]
                tests = list(dict.fromkeys([*suspects, *left, *tests]))
            caught, finished = _try(bench, tree, tests, stage, seconds, result, reached, suspects)
            whole = whole and (finished or stage == "longer")  # what is longer is run again, compiled
            if caught:
                result.slow = chooser.is_slow(result.test)
                break
        if result.status == "missed" and not whole:
            result.status = "unfinished"
        if result.status == "missed" and choice.calling and not choice.calling & reached:
            result.status = "unreached"
    finally:
        shutil.rmtree(tree, ignore_errors=True)
    result.seconds = round(time.monotonic() - began, 1)
    return result


def _reason(fault: Fault, equivalents: list[dict]) -> str:
    """Return why a fault changes nothing, or an empty text."""
    for entry in equivalents:
        if all(entry[key] == getattr(fault, key) for key in ("file", "function", "before", "after")):
            return entry["reason"]
    return ""


def show(entries: list[dict]) -> str:
    """Return the table of results, and what was missed."""
    found = [entry for entry in entries if entry["status"] not in ("equivalent", "unreached")]
    count, lines = Counter(entry["status"] for entry in entries), []
    caught = [entry for entry in found if entry["status"] in ("caught", "timed out")]
    default = [entry for entry in caught if not entry["slow"]]
    judged = max(len(found), 1)
    lines.append(f"{len(entries)} faults: " + ", ".join(f"{number} {status}" for status, number in count.items()))
    lines.append(f"default tests {len(default) / judged:.1%}, with slow ones {len(caught) / judged:.1%}")
    for title, key in (("folder", lambda e: e["file"].split("/")[0]), ("kind", lambda e: e["kind"])):
        lines += ["", f"| {title} | faults | caught | timed out | missed | unfinished |", "|---|---|---|---|---|---|"]
        for name in sorted({key(entry) for entry in found}):
            of = Counter(entry["status"] for entry in found if key(entry) == name)
            cells = [of.total(), *(of[status] for status in ("caught", "timed out", "missed", "unfinished"))]
            lines.append(f"| {name} | " + " | ".join(map(str, cells)) + " |")
    for status in ("missed", "unfinished", "timed out", "unreached", "equivalent"):
        for entry in (each for each in entries if each["status"] == status):
            lines.append(f"\n{status}: {entry['file']}:{entry['line']} {entry['function']} ({entry['ran']} tests)")
            lines.append(f"  - {entry['before']}\n  + {entry['after']}\n  {entry['message']}".rstrip())
    return "\n".join(lines)


def run(options: dict) -> None:
    """Examine the faults that `out` does not hold yet, and print the table."""
    out, began = Path(options["out"]), time.monotonic()
    faults = draw(ROOT / "multilift_marl", options["seed"], options["count"])
    kept = {"caught", "timed out", "missed", "equivalent"}
    entries: dict[str, dict] = {}
    if out.is_file():
        entries = {each["key"]: each for each in json.loads(out.read_text(encoding="utf-8"))}
    equivalents = json.loads(EQUIVALENTS.read_text(encoding="utf-8")) if EQUIVALENTS.is_file() else []
    lock = threading.Lock()

    def note(fault: Fault, result: Result) -> None:
        with lock:
            entries[fault.key] = fault.as_dict() | vars(result)
            part = out.with_suffix(".part")
            part.write_text(json.dumps(list(entries.values()), indent=1, ensure_ascii=False), encoding="utf-8")
            part.replace(out)
        print(f"{result.status:10} {result.seconds:6.1f} s  {fault.file}:{fault.line}  {fault.before}", flush=True)
        print(f"{'':10} {'':8}  {result.test or result.message}  {fault.after}", flush=True)

    with tempfile.TemporaryDirectory(prefix="planted-") as name:
        bench = Bench(Path(name), options, began + options["stop"])
        bench.copy("sound")
        chooser = Chooser(ROOT, Survey.read(Path(options["survey"])), options["tests"] == "all")

        def do(fault: Fault) -> None:
            if entries.get(fault.key, {}).get("status") in kept:
                return
            if reason := _reason(fault, equivalents):
                note(fault, Result("equivalent", message=reason))
            elif time.monotonic() < bench.end - 5:
                note(fault, examine(fault, bench, chooser))

        with ThreadPoolExecutor(options["jobs"]) as pool:
            list(pool.map(do, faults))
    print(show([entries[fault.key] for fault in faults if fault.key in entries]))


def survey(options: dict) -> None:
    """Write which functions each test calls; what `out` already holds stays."""
    out, files = Path(options["out"]).resolve(), test_files(ROOT)
    files.sort(key=lambda name: -(ROOT / name).stat().st_size)
    known = out.read_text(encoding="utf-8") if out.is_file() else ""

    def part(number: int) -> str:
        path = out.with_suffix(f".{number}")
        path.write_text(known, encoding="utf-8")
        environment = os.environ | {
            "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests'}", "PLANTED_SURVEY": str(path), "NUMBA_DISABLE_JIT": "1",
            "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1",
        }  # fmt: skip
        command = [sys.executable, "-m", "pytest", "-q", "-m", "", "-p", "planted_survey", "-p", "no:cacheprovider"]
        subprocess.run([*command, "--tb=no", *files[number :: options["jobs"]]], cwd=ROOT, env=environment)
        text = path.read_text(encoding="utf-8").removeprefix(known)
        path.unlink()
        return text

    with ThreadPoolExecutor(options["jobs"]) as pool:
        added = "".join(pool.map(part, range(options["jobs"])))
    out.write_text(known + added, encoding="utf-8")


def main(arguments: list[str]) -> None:
    """Read the command line; see the module's text."""
    if not arguments or arguments[0] not in ("run", "survey", "list"):
        raise SystemExit(__doc__)
    options: dict = dict(OPTIONS)
    for argument in arguments[1:]:
        key, _, value = argument.partition("=")
        if key not in options:
            raise SystemExit(f"unknown option {key!r}; there are {', '.join(options)}")
        options[key] = type(options[key])(value)
    if arguments[0] == "list":
        for fault in draw(ROOT / "multilift_marl", options["seed"], options["count"]):
            print(f"{fault.key} {fault.file}:{fault.line} {fault.function}\n  - {fault.before}\n  + {fault.after}")
    else:
        {"run": run, "survey": survey}[arguments[0]](options)


if __name__ == "__main__":
    main(sys.argv[1:])
