"""Print the versions that are installed here of all that this package needs, its extras' needs too: constraints.txt.

python .ci/constraints.py > constraints.txt
"""

from __future__ import annotations

import tomllib
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

HEAD = """\
# Versions that the tests of this package pass with, all together:
# pip install -e ".[dev]" -c constraints.txt (docs/faq.md). Written by .ci/constraints.py.
"""


def main() -> None:
    """Print the closure, one package a line."""
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"].values()
    waiting = needed([*project["dependencies"], *(text for extra in extras for text in extra)], "")
    seen, found = {(canonicalize_name(project["name"]), "")}, dict[str, str]()
    while waiting:
        name, extra = waiting.pop()
        if (name, extra) in seen or name == canonicalize_name(project["name"]):
            continue
        seen.add((name, extra))
        with suppress(PackageNotFoundError):  # of another system, say
            package = distribution(name)
            found[name] = f"{package.metadata['Name']}=={Version(package.version).public}"
            waiting += needed(package.requires or [], extra)
    print(HEAD + "\n".join(found[name] for name in sorted(found)))


def needed(texts: list[str], extra: str) -> list[tuple[str, str]]:
    """Return the packages, and extras of them ("" for none), that requirements name for an extra."""
    needs = [Requirement(text) for text in texts]
    needs = [need for need in needs if need.marker is None or need.marker.evaluate({"extra": extra})]
    return [(canonicalize_name(need.name), own) for need in needs for own in ("", *need.extras)]


if __name__ == "__main__":
    main()
