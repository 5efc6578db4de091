"""What `mkdocs build` changes in the pages, so that they are right on the site and when read in the repository.

Links to pages, whose texts are the names of files in the repository, have the pages' titles. Links to files outside
docs/, such as ../configs/hover.yaml, lead to the repository: to `repo_url` of mkdocs.yml, or, where that is not set, to
the files of the clone in which the site was built.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

_LINK = re.compile(r"(\]\()([^)\s#:]+)((?:#[^)]*)?\))")
_PAGE = re.compile(r"\[[\w./]+\.md\]\(([\w./]+\.md)(#[^)]*)?\)")
_COMMENT = re.compile(r"^(<!--.*?-->)\n", re.MULTILINE)
_MARK = "repository:"


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Name pages, mark links that leave docs/, put markers such as <!-- results --> apart from their tables."""
    docs = Path(config.docs_dir)
    folder = (docs / page.file.src_uri).parent

    def mark(link: re.Match[str]) -> str:
        target = Path(os.path.normpath(folder / link[2]))
        if target.is_relative_to(docs):
            return link[0]
        return f"{link[1]}{_MARK}{target.relative_to(docs.parent).as_posix()}{link[3]}"

    def name(link: re.Match[str]) -> str:
        target = folder / link[1]
        if not target.is_file():
            return link[0]
        title = target.read_text(encoding="utf-8").partition("\n")[0].lstrip("# ")
        return f"[{title}]({link[1]}{link[2] or ''})"

    return _COMMENT.sub(r"\1\n\n", _LINK.sub(mark, _PAGE.sub(name, markdown)))


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Let marked links, and pictures, lead to the repository."""
    return re.sub(
        rf'(href|src)="{_MARK}([^"#]+)', lambda found: f'{found[1]}="{_address(found[2], found[1], page, config)}', html
    )


def _address(path: str, attribute: str, page: Page, config: MkDocsConfig) -> str:
    """Return where a file or folder of the repository can be seen, as the attribute `href` or `src`."""
    root = Path(config.docs_dir).parent
    if not config.repo_url:
        return Path(os.path.relpath(root / path, Path(page.file.abs_dest_path).parent)).as_posix()
    kind = "raw" if attribute == "src" else "tree" if (root / path).is_dir() else "blob"
    return f"{config.repo_url.rstrip('/')}/{kind}/HEAD/{path}"
