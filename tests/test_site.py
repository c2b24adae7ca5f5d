"""The site: whole, strict, nothing fetched from other machines."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from notebooks.make_pictures import PICTURES
from notebooks.run_notebooks import NOTEBOOKS

ROOT = Path(__file__).parent.parent
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
