"""The release: from source distribution to a clean environment; versions, licences, forms."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from datetime import date
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml

import multilift_marl as ml
from multilift_marl.kernels.cache import cache_folder

ROOT = Path(__file__).parents[2]
USE = """
import pathlib, sys
import multilift_marl as ml
from multilift_marl.policies.baselines import make_scripted
folder = pathlib.Path(ml.__file__).parent
assert folder.is_relative_to(sys.prefix), folder
vec = ml.make_vec("hover", num_envs=2)
observation, _ = vec.reset(seed=1)
vec.step(make_scripted("formation", vec).act(observation))
for name in sys.argv[1:]:
    assert (folder / name).is_file(), name
print(ml.__version__)
"""


def run(*command: str | Path, **more):
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, **more)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def release(tmp_path_factory):
    """Return an sdist, and the wheel that is built from it."""
    out = tmp_path_factory.mktemp("release")
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", out]
    run(*build, "--sdist", ROOT)
    sdist = next(out.glob("*.tar.gz"))
    with tarfile.open(sdist) as archive:
        archive.extractall(out, filter="data")
    run(*build, "--wheel", out / sdist.name.removesuffix(".tar.gz"))
    return sdist, next(out.glob("*.whl"))


@pytest.mark.slow
def test_sdist_and_wheel_have_one_version_and_the_licence(release):
    sdist, wheel = release
    number = sdist.name.removeprefix("multilift_marl-").removesuffix(".tar.gz")
    assert wheel.name == f"multilift_marl-{number}-py3-none-any.whl"
    names = zipfile.ZipFile(wheel).namelist()
    for name in ("LICENSE", "NOTICE"):
        assert f"multilift_marl-{number}.dist-info/licenses/{name}" in names
        with tarfile.open(sdist) as archive:
            assert f"multilift_marl-{number}/{name}" in archive.getnames()


@pytest.mark.slow
def test_wheel_from_the_sdist_works_in_a_clean_environment(release, tmp_path):
    """Pip installs it with its dependencies, none from here: what they lack is found out."""
    venv.create(tmp_path / "clean", with_pip=True, system_site_packages=False)
    python = tmp_path / "clean" / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    run(python, "-m", "pip", "install", "-q", release[1], cwd=tmp_path)
    shipped = [f"policies/{path.name}" for path in (ROOT / "multilift_marl" / "policies").glob("*.pt")]
    shipped += [f"configs/{path.relative_to(ROOT / 'configs')}" for path in (ROOT / "configs").rglob("*.yaml")]
    assert len(shipped) > 40
    kernels = cache_folder("multilift_marl.math3d").parents[1]
    own = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    found = run(python, "-c", USE, *shipped, cwd=tmp_path, env=own | {"NUMBA_CACHE_DIR": str(kernels)})
    assert f"multilift_marl-{found.strip()}-" in release[1].name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "expected"), [("no git", "0.1.0.dev0"), ("no tags", "0.1.0.dev1+g"), ("tagged", "0.3.1")]
)
def test_the_version_is_that_of_the_tag(kind, expected, tmp_path):
    clone = tmp_path / "clone"
    run("git", "clone", "-q", "--depth", "1", "--no-tags", ROOT.as_uri(), clone)
    if kind == "no git":
        (clone / ".git").rename(tmp_path / "elsewhere")
    elif kind == "tagged":
        run("git", "-C", clone, "tag", "v0.3.1")
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", tmp_path, clone)
    assert next(tmp_path.glob("*.whl")).name.split("-")[1].startswith(expected)


def test_the_version_is_that_of_the_installed_package():
    try:
        assert ml.__version__ == version("multilift_marl")
    except ModuleNotFoundError:
        assert ml.__version__ == "0+unknown"


def test_forms_and_citation_are_yaml():
    for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"):
        form = yaml.safe_load(path.read_text(encoding="utf-8"))
        assert form["name"] and form["description"]
        assert all(part["type"] == "textarea" and part["attributes"]["label"] for part in form["body"])
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors", "license", "abstract", "references"} <= set(citation)
    for reference in citation["references"]:
        assert {"type", "title", "authors", "year"} <= set(reference)


def test_citation_is_of_the_newest_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    headings = re.findall(r"^## \[(\d.*?)\] - (.*)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    number, day = headings[0]
    assert str(citation["version"]) == number
    assert isinstance(citation["date-released"], date)
    assert day == "not tagged" or citation["date-released"].isoformat() == day


def image():
    """Return the instructions of the Dockerfile, [name, rest], lines joined."""
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8").replace("\\\n", " ")
    return [line.split(maxsplit=1) for line in text.splitlines() if line and not line.startswith("#")]


def test_the_image_runs_the_first_command_of_the_readme_as_no_root():
    last = {name: rest for name, rest in image()}
    first = re.search(r"```bash\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)[1]
    assert json.loads(last["CMD"]) == first.split("&&")[-1].split()
    assert last["USER"] not in ("root", "0")
    order = [name for name, _ in image()]
    assert order.index("USER") < order.index("COPY") and order.count("USER") == 1


def test_the_image_has_pytorch_for_cpus_and_the_known_versions():
    installs = [rest for name, rest in image() if name == "RUN" and "pip install" in rest]
    assert all("-c constraints.txt" in rest for rest in installs)
    assert "--index-url https://download.pytorch.org/whl/cpu" in installs[0] and installs[0].endswith(" torch")
    assert "torch.version.cuda is None" in installs[-1]


def test_the_image_is_given_what_it_installs_and_nothing_else():
    lines = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    assert "*" in lines
    given = {line[1:] for line in lines if line.startswith("!")}
    assert all((ROOT / name).exists() for name in given)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    needed = {*wheel["packages"], *wheel["force-include"], project["project"]["readme"]}
    needed |= {*project["project"]["license-files"], "pyproject.toml", "constraints.txt", "train.py", "evaluate.py"}
    assert given == needed


@pytest.mark.skipif(sys.platform == "win32" or not shutil.which("bash"), reason="a shell script")
def test_without_docker_the_script_says_so(tmp_path):
    for name in ("dirname", "env"):
        (tmp_path / name).symlink_to(shutil.which(name))
    script = [shutil.which("bash"), ROOT / ".ci" / "docker"]
    done = subprocess.run(script, capture_output=True, text=True, env={"PATH": str(tmp_path)})
    assert done.returncode == 3 and done.stdout == ""
    assert done.stderr.startswith("no image was built: ") and done.stderr.count("\n") == 1


@pytest.mark.slow
@pytest.mark.timeout(3600)  # base image and packages are downloaded
def test_the_image_is_built_where_docker_is():
    done = subprocess.run(["bash", ROOT / ".ci" / "docker"], capture_output=True, text=True)
    if done.returncode == 3:
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0, done.stdout + done.stderr


def test_changelog_has_a_place_for_what_is_not_released():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert text.index("## [Unreleased]") < text.index("## [0.1.0]")


def test_nothing_of_others_is_shipped():
    """The NOTICE says that there are no meshes, and whose the policies are."""
    files = [path for folder in ("multilift_marl", "configs") for path in (ROOT / folder).rglob("*.*")]
    kinds = {path.suffix for path in files if "__pycache__" not in path.parts}  # which holds compiled kernels
    assert kinds <= {".py", ".pt", ".typed", ".yaml"}
