"""What results depend on beside configuration and seed: versions, and the package's sources."""

import mujoco
import pytest

import multilift_marl as ml
from multilift_marl._versions import digest_sources, find_versions


@pytest.fixture
def package(tmp_path):
    """A package of a module, gains, and the configurations that an installed one holds."""
    for name, text in {"a.py": "x = 1\n", "gains/a.yaml": "k: 1\n", "configs/a.yaml": "k: 1\n"}.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(text.encode())
    return tmp_path


def digest(package):
    digest_sources.cache_clear()
    return digest_sources(package)


@pytest.mark.parametrize(
    ("name", "text", "same"),
    [
        ("a.py", "x = 2\n", False),
        ("gains/a.yaml", "k: 2\n", False),
        ("b.py", "", False),
        ("a.py", "x = 1\r\n", True),  # as Git writes it on Windows
        ("configs/a.yaml", "k: 2\n", True),
        ("__pycache__/a.pyc", "x", True),
    ],
)
def test_the_digest_is_of_code_and_gains_alone(package, name, text, same):
    before = digest(package)
    (package / name).parent.mkdir(exist_ok=True)
    (package / name).write_bytes(text.encode())
    assert (digest(package) == before) == same


def test_versions_are_those_of_the_package_of_its_sources_and_of_mujoco():
    assert find_versions() == {
        "multilift_marl": ml.__version__, "sources": digest_sources(), "mujoco": mujoco.__version__
    }  # fmt: skip
    assert len(digest_sources()) == 16
