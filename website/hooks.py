"""Hooks of MkDocs: pages of the site that lie outside docs/, and links that leave it.

README.md is the home page, `website/pages/` holds the gallery and the pages of the Python API, `examples/notebooks/` the
notebooks, as they were executed for `build/notebooks/` (`make site`) where that is newer. A link to another file of the repository
becomes one to the repository's URL, so that every page reads alike on the site and in the repository.
"""

import logging
import re
from pathlib import Path
from posixpath import dirname, join, normpath, relpath

import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from nbconvert import MarkdownExporter

ROOT = Path(__file__).parents[1]
PAGES, NOTEBOOKS, EXECUTED = ROOT / "website/pages", ROOT / "examples/notebooks", ROOT / "build/notebooks"
HOME = "index.md"
BRANCH = "main"
LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#|/)([^)#\s]+)(#[^)\s]*)?(?=\))")
"""A relative link's file and anchor."""
FENCED = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)
VIDEO = re.compile(r'<img alt="([^"]*)" src="([^"]*\.mp4)" ?/?>')
log = logging.getLogger("mkdocs.hooks.wearcap")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that lie outside docs/."""
    files.append(File.generated(config, HOME, abs_src_path=str(ROOT / "README.md")))
    for path in sorted(path for path in PAGES.rglob("*") if path.is_file()):
        files.append(File.generated(config, path.relative_to(PAGES).as_posix(), abs_src_path=str(path)))
    for source in sorted(NOTEBOOKS.glob("*.ipynb")):
        for name, content in notebook(source).items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    return files


def notebook(source: Path) -> dict[str, str | bytes]:
    """A notebook's page, as Markdown, without what was written to stderr, and the pictures of its outputs, by file name."""
    executed = EXECUTED / source.name
    shown = executed if executed.is_file() and executed.stat().st_mtime >= source.stat().st_mtime else source
    content = nbformat.read(shown, 4)
    for cell in content.cells:
        outputs = cell.get("outputs", [])
        outputs[:] = [output for output in outputs if output.get("name") != "stderr"]
    made, resources = MarkdownExporter().from_notebook_node(content, {"unique_key": source.stem})
    return {f"{source.stem}.md": made, **resources.get("outputs", {})}


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """The page, with its links outside of blocks of code as the site needs them."""
    if page.file.src_uri == HOME:
        page.meta["hide"] = ["navigation"]
    elif page.file.src_uri.startswith("notebooks/"):
        page.meta["hide"] = ["toc"]
    elif page.file.src_uri.startswith("api/"):
        page.meta["search"] = {"boost": 0.5}  # behind the guides
    parts = FENCED.split(markdown)
    parts[::2] = [LINK.sub(lambda link: mended(link, page.file.src_uri, config, files), part) for part in parts[::2]]
    return "".join(parts)


def mended(link: re.Match[str], page: str, config: MkDocsConfig, files: Files) -> str:
    """A link of a page as the site needs it; one to nothing, on the site or in the repository, makes a warning."""
    target, anchor = link[1], link[2] or ""
    if files.get_file_from_path(normpath(join(dirname(page), target))):
        return target + anchor
    path = normpath(join(dirname(in_repository(page)), target))
    shown = path.removeprefix("docs/").removeprefix("examples/").replace(".ipynb", ".md")
    if files.get_file_from_path(shown):
        return relpath(shown, dirname(page) or ".") + anchor
    if path.startswith("..") or not (ROOT / path).exists():
        log.warning(f"{page} links {target}, which is neither on the site nor in the repository")
    return f"{config.repo_url}/{'tree' if (ROOT / path).is_dir() else 'blob'}/{BRANCH}/{path}{anchor}"


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """The page with pictures that are videos as such."""
    return VIDEO.sub(r'<video controls loop muted playsinline preload="metadata" title="\1" src="\2"></video>', html)


def in_repository(page: str) -> str:
    """The path of a page of the site in the repository."""
    return "README.md" if page == HOME else f"examples/{page}" if page.startswith("notebooks/") else f"docs/{page}"
