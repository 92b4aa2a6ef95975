"""Parts of the site beyond the pages in `docs` (hooks of MkDocs): pages and tables made from the code, other files.

A page may link to any file of the repository, as it does when it is read there. On the site README's neighbours are
pages, other files are copied to `files/`, and a directory's name is no link.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[3]
if str(ROOT / "tools") not in sys.path:
    sys.path.insert(0, str(ROOT / "tools"))
from dtsa_bench.log.tables import describe  # noqa: E402
from dtsa_dev.documents import pages, tables  # noqa: E402

#: Pages that stand at the top of the repository, and where they are on the site.
TOP = {
    "REPRODUCTION.md": "evidence/reproduction.md",
    "CONTRIBUTING.md": "project/contributing.md",
    "CHANGELOG.md": "project/changelog.md",
}
MADE = {
    "reference/columns.md": describe,
    "reference/commands.md": pages.commands,
    "reference/messages.md": pages.messages,
    "reference/library.md": pages.library,
}
#: How much more, or less, a page of a part counts in a search; `search: {boost: N}` at a page's head overrides it.
BOOST = {"tutorials": 1.5, "how-to": 2.0, "evidence": 0.7, "project": 0.2, "reference/library.md": 0.5}
_LINK = re.compile(r"\[(?P<label>(?:[^\[\]]|\[[^\[\]]*\])*)\]\((?P<url>[^)\s]+)\)")
_ROLE = re.compile(r":(?:class|func|meth|mod|data|attr|exc):\s?<code>[.~]?")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are not in `docs`."""
    for name, place in TOP.items():
        files.append(File.generated(config, place, content=(ROOT / name).read_text(encoding="utf-8")))
    for place, page in MADE.items():
        files.append(File.generated(config, place, content=page()))
    for file in list(files.documentation_pages()):
        for match in _LINK.finditer(file.content_string):
            path = _path(file.src_uri, match["url"])
            if path is not None and path.is_file() and files.get_file_from_path(_on_site(path)) is None:
                files.append(File.generated(config, _on_site(path), abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: Any, files: Files) -> str:
    """Fill in tables, link to what the site has of the repository's files, and set what counts in a search."""
    place = page.file.src_uri
    boost = BOOST.get(place, BOOST.get(place.partition("/")[0], 1.0))
    page.meta.setdefault("search", {}).setdefault("boost", boost)

    def link(match: re.Match[str]) -> str:
        url = match["url"]
        path = _path(place, url)
        if path is None or not path.exists():
            return match[0]
        if path.is_dir():
            return match["label"]
        anchor = url.partition("#")[1] + url.partition("#")[2]
        return f"[{match['label']}]({os.path.relpath(_on_site(path), Path(place).parent)}{anchor})"

    return _LINK.sub(link, tables.filled(markdown))


def on_page_content(html: str, page: Page, config: Any, files: Files) -> str:
    """Remove the roles that docstrings write before names."""
    return _ROLE.sub("<code>", html)


def _path(place: str, url: str) -> Path | None:
    """The file or directory that a page links to, None if it is no file's link or one within `docs`."""
    name = url.partition("#")[0]
    if not name or "://" in url or url.startswith("mailto:") or place in MADE:
        return None
    source = {place_on_site: ROOT / here for here, place_on_site in TOP.items()}.get(place, ROOT / "docs" / place)
    path = Path(os.path.normpath(source.parent / name))
    inside = source.is_relative_to(ROOT / "docs") and path.is_relative_to(ROOT / "docs")
    return None if inside or not path.is_relative_to(ROOT) else path


def _on_site(path: Path) -> str:
    """Where a file of the repository is on the site."""
    name = path.relative_to(ROOT).as_posix()
    return TOP.get(name, name.removeprefix("docs/") if name.startswith("docs/") else f"files/{name}")
