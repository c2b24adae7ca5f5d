"""The site: whole, strict, nothing fetched from other machines; its search works in a browser."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from notebooks.make_pictures import PICTURES
from notebooks.run_notebooks import NOTEBOOKS

ROOT = Path(__file__).parent.parent
CHROMIUM = next(
    (place for name in ("chromium", "chromium-browser", "google-chrome") if (place := shutil.which(name))), ""
)
needs_browser = pytest.mark.skipif(not (CHROMIUM and find_spec("playwright")), reason="no Chromium, or no playwright")
UNTESTED_NOTEBOOKS = """
import shutil, sys
from pathlib import Path
import notebooks.run_notebooks as notebooks
folder = Path(sys.argv.pop(1)) / "gallery"
folder.mkdir()
notebooks.kept = lambda path: Path(shutil.copy(path, folder / path.name))
from mkdocs.__main__ import cli
cli()
"""
"""mkdocs, with the notebooks as they are stored: what they show when they run is `tests/test_notebooks.py`'s."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    options = ["--strict", "--quiet", "--config-file", "notebooks/mkdocs.yml", "--site-dir", str(folder / "site")]
    done = subprocess.run(
        [sys.executable, "-c", UNTESTED_NOTEBOOKS, str(folder), "build", *options],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder / "site"


@pytest.fixture
def page() -> Iterator[Any]:
    """A page of a browser."""
    with pytest.importorskip("playwright.sync_api").sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser.new_page(viewport={"width": 1400, "height": 1000})
        browser.close()


def test_pictures_stand_beside_their_commands():
    pages = ROOT / "notebooks" / "pages"
    text = " ".join(" ".join(page.read_text(encoding="utf-8") for page in pages.glob("*.md")).split())
    files = {path.stem: path.name for path in sorted((pages / "pictures").iterdir())}
    assert files.keys() == {*PICTURES, "figure3"}
    for picture, command in PICTURES.items():
        assert f"(pictures/{files[picture]})" in text
        assert f"`afm-jax {command}`" in text


@pytest.mark.slow
def test_links_lead_somewhere_and_nothing_is_fetched_from_other_machines(site: Path):
    pages = [page for page in site.rglob("*.html") if page.name != "404.html"]  # that one is for servers
    assert len(pages) > 25
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert not re.search(r"<(?:script|link|img|iframe)\b[^>]*(?:src|href)=\"?https?://", text), page
        for link in re.findall(r'href="(?!\w+:)([^"#?]+)', text):
            assert (page.parent / link).exists(), (page.name, link)
    gallery = (site / "gallery" / "index.html").read_text(encoding="utf-8")
    assert all(f'href="{path.stem}.html"' in gallery for path in NOTEBOOKS)
    assert "(pictures/figure3.svg)" in (ROOT / "notebooks" / "pages" / "index.md").read_text(encoding="utf-8")
    assert "capture_speed" in (site / "api.html").read_text(encoding="utf-8")
    assert "--scale-errors" in (site / "commands.html").read_text(encoding="utf-8")


@pytest.mark.slow
@needs_browser
def test_search_works_from_disk(site: Path, page: Any):
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto((site / "index.html").as_uri())
    page.locator("input.md-search__input").press_sequentially("capture speed")
    page.locator(".md-search-result__item").first.wait_for(timeout=60_000)
    assert {url.partition(":")[0] for url in asked} <= {"file", "data", "blob", "about"}
