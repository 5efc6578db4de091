"""What `mkdocs build` changes in the pages, so that they are right on the site and when read in the repository.

Links to files outside docs/, such as ../configs/hover.yaml, lead to the repository: to `repo_url` of mkdocs.yml, or,
where that is not set, to the files of the clone in which the site was built.
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
_COMMENT = re.compile(r"^(<!--.*?-->)\n", re.MULTILINE)
_MARK = "repository:"


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Mark links that leave docs/, and put markers such as <!-- results --> apart from the tables that they hold."""
    docs = Path(config.docs_dir)
    folder = (docs / page.file.src_uri).parent

    def mark(link: re.Match[str]) -> str:
        target = Path(os.path.normpath(folder / link[2]))
        if target.is_relative_to(docs):
            return link[0]
        return f"{link[1]}{_MARK}{target.relative_to(docs.parent).as_posix()}{link[3]}"

    return _COMMENT.sub(r"\1\n\n", _LINK.sub(mark, markdown))


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
