"""Simulated drone-seconds per second of multilift_marl and of other simulators of drones, in turn on this machine.

    python bench/peers.py cache=<folder> [repeats=3] [seconds=5] [peers=<name>,<name>] [save=true]
    python bench/peers.py table

Each peer is installed by pip in a virtual environment of its own below `cache`, and stays there for the next run; what
cannot be installed is named and left out. Each measurement is a process of its own, `peer_scripts/fly_<name>.py`: it
compiles and warms up, then flies drones to set-points for `seconds`, on the CPU. All are measured in turn, `repeats`
times; medians are reported with the least and the largest. `save=true` writes results/peers.json and the tables of
docs/peers.md; `table` writes the tables from the recorded results.
"""

from __future__ import annotations

import datetime
import json
import os
import re
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]
SCRIPTS = Path(__file__).parent / "peer_scripts"
RESULTS = ROOT / "results" / "peers.json"
PAGE = ROOT / "docs" / "peers.md"
OWN = "multilift_marl"
KEYS = {"cache": "", "repeats": "3", "seconds": "5", "peers": "", "save": "false"}
FEW, MANY = (4, 1), (1024, 1)  # drones, threads
ALL = (FEW, MANY, (1024, 2))


class Unavailable(Exception):
    """A peer that cannot be measured; the message is one sentence."""


class Peer(NamedTuple):
    """A simulator to measure."""

    requirements: tuple[str, ...]
    """What pip installs."""
    cases: tuple[tuple[int, int], ...]
    """Drones and threads to measure; threads have no effect where a library has its own."""
    simulates: str
    omits: str
    """What it does not simulate in this measurement."""


PEERS = {
    OWN: Peer(
        (),
        ALL,
        "drones, motor lag, drag, cables, a payload, contact (MuJoCo); controller, observations, rewards",
        "wind, rotor wash and sensors (available, off here)",
    ),
    "crazyflow": Peer(
        ("crazyflow",),
        (FEW, MANY),
        "drones, motor lag, drag; controller",
        "cables, payload, contact forces, wind",
    ),
    "pyflyt": Peer(
        ("PyFlyt",),
        (FEW,),
        "drones, motor lag and noise, drag, contact (Bullet); controller",
        "cables, payload; wind (available, off here); batches",
    ),
    "rotorpy": Peer(
        ("rotorpy[batched]", "torch>=2.6,<2.14"),
        ALL,
        "drones, motor lag and noise, drag; controller",
        "cables, payload, contact; wind (available, off here)",
    ),
    "vmas": Peer(
        ("vmas", "torch>=2.6,<2.14"),
        ALL,
        "drones, contact in the horizontal plane; observations, rewards",
        "cables, payload, motors and their lag, wind, drag but in the plane; a controller (it is the script's)",
    ),
    "gym-pybullet-drones": Peer(("gym-pybullet-drones",), (), "", ""),
}


def environment() -> dict[str, str]:
    """Return the environment variables of a peer: no other packages, no GPU."""
    kept = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
    return kept | {"CUDA_VISIBLE_DEVICES": "", "JAX_PLATFORMS": "cpu"}


def interpreter(name: str, cache: str) -> str:
    """Return the Python that runs a peer, after installing the peer where the cache has none.

    Raises:
        Unavailable: it cannot be installed.
    """
    peer = PEERS[name]
    if not peer.requirements:
        return sys.executable
    if not cache:
        raise Unavailable(f"{name} is not measured: cache=<folder> says where to install it.")
    folder = Path(cache).resolve() / name
    python = folder / "bin" / "python"
    done = folder / "requirements.json"
    wanted = json.dumps(peer.requirements)
    if done.is_file() and done.read_text(encoding="utf-8") == wanted:
        return str(python)
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    line = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *peer.requirements]
    installed = subprocess.run(line, capture_output=True, text=True, env=environment())
    if installed.returncode:
        raise Unavailable(f"{name} is not measured: pip cannot install it ({last_line(installed.stderr)}).")
    done.write_text(wanted, encoding="utf-8")
    return str(python)


def last_line(text: str) -> str:
    """Return the last line of an error, which says what it was."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1].removeprefix("ERROR: ").rstrip(".") if lines else "no message"


def fly(name: str, python: str, drones: int, threads: int, seconds: float) -> dict[str, Any]:
    """Return what the script of a peer measured.

    Raises:
        Unavailable: there is none, or it fails.
    """
    script = SCRIPTS / f"fly_{name.replace('-', '_')}.py"
    if not script.is_file():
        raise Unavailable(f"{name} is not measured: there is no bench/peer_scripts/{script.name}.")
    line = [python, str(script), f"drones={drones}", f"threads={threads}", f"seconds={seconds}"]
    env = dict(os.environ) if name == OWN else environment()
    done = subprocess.run(line, capture_output=True, text=True, env=env)
    if done.returncode:
        raise Unavailable(f"{name} is not measured: its script fails ({last_line(done.stderr)}).")
    return json.loads(done.stdout.splitlines()[-1])


def measure(names: list[str], cache: str, repeats: int, seconds: float) -> dict[str, Any]:
    """Measure peers in turn and return what is recorded."""
    load = os.getloadavg()[0]
    flights: dict[tuple[str, int, int], list[dict[str, Any]]] = {}
    missing: dict[str, str] = {}
    pythons: dict[str, str] = {}
    for name in names:
        try:
            pythons[name] = interpreter(name, cache)
            for drones, threads in PEERS[name].cases or (FEW,):
                fly(name, pythons[name], drones, threads, 0.1)  # fills caches; says early what cannot run
        except Unavailable as error:
            missing[name] = str(error)
            print(error, file=sys.stderr)
    for repeat in range(repeats):
        for name in names:
            for drones, threads in () if name in missing else PEERS[name].cases:
                try:
                    found = fly(name, pythons[name], drones, threads, seconds)
                except Unavailable as error:
                    missing[name] = str(error)
                    print(error, file=sys.stderr)
                    break
                flights.setdefault((name, drones, threads), []).append(found)
                rate = f"{found['rate']:.1f} drone-s/s"
                print(f"{repeat + 1}/{repeats} {name}, {drones} drones, {threads} threads: {rate}", file=sys.stderr)
    return {
        "date": datetime.date.today().isoformat(),
        "cpu": cpu(),
        "cores": os.cpu_count(),
        "load_before": round(load, 2),
        "load_after": [round(value, 2) for value in os.getloadavg()],
        "repeats": repeats,
        "seconds": seconds,
        "rows": [summarise(*key, found) for key, found in flights.items() if key[0] not in missing],
        "missing": missing,
    }


def summarise(name: str, drones: int, threads: int, flights: list[dict[str, Any]]) -> dict[str, Any]:
    """Return one row of the results: all rates, and what else the script of a peer reported."""
    facts = {key: value for key, value in flights[0].items() if key not in ("rate", "simulated", "wall", "cores")}
    errors = [flight["error"] for flight in flights if flight["error"] is not None]
    facts["cores_used"] = round(statistics.median(flight["cores_used"] for flight in flights), 2)
    facts["resets"] = sum(flight["resets"] for flight in flights)
    facts["error"] = round(statistics.median(errors), 4) if errors else None
    return {"peer": name, "threads": threads, "rates": [round(flight["rate"], 2) for flight in flights]} | facts


def cpu() -> str:
    """Return the name of the processor."""
    try:
        found = re.search(r"model name\s*: (.+)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    except OSError:
        return "unknown"
    return found[1] if found else "unknown"


def table(results: dict[str, Any]) -> str:
    """Return what was measured as Markdown."""
    lines = [
        f"Measured {results['date']} on {results['cores']} cores ({results['cpu']}), with a load of "
        f"{results['load_before']:g} before and {results['load_after'][0]:g} after; medians (least - largest) of "
        f"{results['repeats']} runs of {results['seconds']:g} s each.",
        "",
        "| simulator | drones | worlds | threads | drone-s/s | cores used | physics, policy [Hz] | "
        "1000 physics steps/s | error [cm] |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in results["rows"]:
        rates = row["rates"]
        middle, least, most = (amount(value) for value in (statistics.median(rates), min(rates), max(rates)))
        error = "-" if row["error"] is None else f"{100 * row['error']:.1f}"
        threads = "its own" if row["peer"] == "crazyflow" else row["threads"]
        lines.append(
            f"| {row['peer']} | {row['drones']} | {row['worlds']} | {threads} | {middle} ({least} - {most}) | "
            f"{row['cores_used']:.2f} | {row['physics_hz']:g}, {row['policy_hz']:g} | "
            f"{amount(statistics.median(rates) * row['physics_hz'] / 1000)} | {error} |"
        )
    resets = sum(row["resets"] for row in results["rows"])
    lines += ["", f"Worlds reset after a crash, in all: {resets}."]
    lines += [" ".join(results["missing"].values())] if results["missing"] else []
    return "\n".join(lines)


def amount(rate: float) -> str:
    """Return a rate with three digits or all of its whole ones."""
    return f"{rate:,.0f}" if rate >= 100 else f"{rate:.3g}"


def features(results: dict[str, Any]) -> str:
    """Return what each peer that was measured simulates, and its versions, as Markdown."""
    lines = ["| simulator | versions | simulated | not simulated |", "|---|---|---|---|"]
    versions = {row["peer"]: row["versions"] for row in results["rows"]}
    for name, found in versions.items():
        named = ", ".join(f"{package} {number}" for package, number in found.items())
        lines.append(f"| {name} | {named} | {PEERS[name].simulates} | {PEERS[name].omits} |")
    return "\n".join(lines)


def write_tables(page: Path = PAGE) -> None:
    """Replace the text between the markers in the document."""
    results = json.loads(RESULTS.read_text(encoding="utf-8"))
    text = page.read_text(encoding="utf-8")
    for name, content in (("peers", table(results)), ("features", features(results))):
        marked = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end of {name} -->)", re.DOTALL)
        text = marked.sub(lambda found, content=content: f"{found[1]}{content}\n{found[2]}", text)
    page.write_text(text, encoding="utf-8")


def main(arguments: list[str]) -> int:
    """Measure, print the table, and record it where asked to."""
    if arguments == ["table"]:
        write_tables()
        return 0
    given = dict(part.partition("=")[::2] for part in arguments)
    names = [name for name in given.get("peers", "").split(",") if name] or list(PEERS)
    for wrong, known in ((given.keys() - KEYS.keys(), KEYS), (set(names) - PEERS.keys(), PEERS)):
        if wrong:
            print(f"error: unknown: {', '.join(sorted(wrong))}; known: {', '.join(known)}", file=sys.stderr)
            return 2
    values = KEYS | given
    if values["save"] == "true" and given.get("peers"):
        print("error: save=true records all peers; leave out peers", file=sys.stderr)
        return 2
    results = measure(names, values["cache"], int(values["repeats"]), float(values["seconds"]))
    print(table(results))
    if values["save"] == "true":
        RESULTS.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
        write_tables()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
