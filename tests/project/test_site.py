"""The site of the documentation: it builds without a warning, holds every page, and its links lead somewhere."""

import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
import yaml
from conftest import load_script

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))
REPOSITORY = "https://repository.invalid/team/multilift"


class Links(HTMLParser):
    """Addresses and anchors of a page."""

    def __init__(self, html):
        super().__init__()
        self.targets, self.anchors = [], set()
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.anchors.add(attributes.get("id"))
        self.targets += [attributes[key] for key in ("href", "src") if key in attributes and tag != "link"]


def build(out, **environment):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=os.environ | environment)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    out = tmp_path_factory.mktemp("site")
    build(out, REPOSITORY_URL="")
    return {
        path.relative_to(out).as_posix(): Links(path.read_text(encoding="utf-8")) for path in out.rglob("*.html")
    }, out


def nav():
    """Return the pages of mkdocs.yml's nav, and those that it names as `not_in_nav`."""
    settings = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8").replace("!ENV", ""))
    parts, pages = settings["nav"], [line.strip("/ ") for line in settings.get("not_in_nav", "").split()]
    while parts:
        (content,) = parts.pop().values()
        if isinstance(content, str):
            pages.append(content)
        else:
            parts += content
    return pages


@pytest.mark.parametrize("page", PAGES)
def test_nav_lists(page):
    assert page in nav(), f"docs/{page} is missing from the nav of mkdocs.yml"


def test_nav_lists_each_page_once():
    assert sorted(nav()) == PAGES


@pytest.mark.slow
def test_links_of_the_site_lead_to_files_and_anchors(site):
    pages, out = site
    checked = 0
    for name, page in pages.items():
        for target in page.targets:
            link = urlsplit(target)
            if link.scheme or link.netloc or name == "404.html":
                continue
            path = os.path.normpath(out / os.path.dirname(name) / unquote(link.path)) if link.path else str(out / name)
            assert os.path.exists(path), f"{name}: {target}"
            inside = os.path.relpath(path, out)
            if link.fragment and inside in pages:
                assert unquote(link.fragment) in pages[inside].anchors, f"{name}: {target}"
            checked += 1
    assert checked > 1000


@pytest.mark.slow
def test_links_to_the_repository_lead_there(tmp_path):
    build(tmp_path, REPOSITORY_URL=REPOSITORY)
    hover = Links((tmp_path / "hover.html").read_text(encoding="utf-8")).targets
    assert f"{REPOSITORY}/blob/HEAD/configs/hover.yaml" in hover
    pages = [Links(path.read_text(encoding="utf-8")).targets for path in tmp_path.rglob("*.html")]
    assert any(target.startswith(f"{REPOSITORY}/raw/HEAD/results/") for page in pages for target in page)
    assert not [target for page in pages for target in page if target.startswith(("repository:", "../configs"))]


@pytest.mark.parametrize("page", PAGES)
def test_tables_and_lists_are_rendered(page, site):
    markdown = re.sub(r"```.*?```", "", (DOCS / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    html = (site[1] / page).with_suffix(".html").read_text(encoding="utf-8")
    tables = re.findall(r"^\|(?:\s*:?-+:?\s*\|)+$", markdown, re.MULTILINE)
    assert html.count("<table>") >= len(tables)
    assert not re.findall(r"<p>\|", html)
    assert not re.findall(r"^(?:- |\d+\. )", re.sub(r"<pre.*?</pre>", "", html, flags=re.DOTALL), re.MULTILINE)


def test_links_have_titles_as_their_texts(site):
    found = {name: re.findall(r">[\w./]+\.md</a>", (site[1] / name).read_text(encoding="utf-8")) for name in site[0]}
    assert {name: texts for name, texts in found.items() if texts} == {}
    assert '<a href="tasks.html">Tasks</a>' in (site[1] / "index.html").read_text(encoding="utf-8")


def test_the_readme_is_one_page_with_an_animation():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 120
    assert "](docs/images/navigate_senses.gif)" in text


def test_animations_are_small_and_of_the_script():
    clips = load_script("docs/clips").CLIPS
    assert {path.stem for path in (DOCS / "images").glob("*.gif")} == clips.keys()
    for name, clip in clips.items():
        assert (DOCS / "images" / f"{name}.gif").stat().st_size <= clip.most


def test_every_task_has_a_clip_in_the_gallery(task):
    assert f"](images/clip_{task}.gif)" in (DOCS / "gallery.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_notebook_runs(tmp_path):
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(ROOT / "examples" / "tutorial.ipynb", as_version=4)
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    images = [out for cell in notebook.cells for out in cell.get("outputs", []) if "image/png" in out.get("data", {})]
    assert len(images) >= 2


def test_the_notebook_holds_nothing_of_a_machine():
    text = (ROOT / "examples" / "tutorial.ipynb").read_text(encoding="utf-8")
    assert not re.findall(r"/(?:home|tmp|root|work|usr|Users)/", text)
    cells = json.loads(text)["cells"]
    assert not [
        cell for cell in cells if cell.get("outputs") and "error" in {out["output_type"] for out in cell["outputs"]}
    ]
