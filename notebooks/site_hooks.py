"""What the site's build adds to the pages: notebooks as they ran, commands from their own help, the public names."""

import base64
import re
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import click
import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

import afm_jax
import fitting
from afm_jax.cli.main import main
from afm_jax.compilation_cache import available_cores
from notebooks.run_notebooks import NOTEBOOKS, ROOT, kept

_KEPT_ELSEWHERE = {
    "design_notes.md": "notebooks/design_notes.md",
    "adding_a_force.md": "notebooks/adding_a_force.md",
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "security.md": "SECURITY.md",
}
_GALLERY = """Eight notebooks show whole studies. Each is shown as it ran, ends with assertions on its claims, and is
run by the tests. They are in the repository's folder `notebooks/`."""
_CODE_IN_CELLS = re.compile(r"(?<=<code>)[^<]*(?=</code>(?:(?!<t[dh]|</table>).)*</t[dh]>)", re.DOTALL)
_JOINT = re.compile(r"(?<=[a-z]_)(?=[a-z0-9])|(?<=[(=/,])(?=[\w&])|(?<=[a-z]\.)(?=[a-z])")
_WHOLE = re.compile(r"(?<![\w-])(--[a-z][\w-]*|afm-jax)")
_FROM_AFAR = re.compile(
    r'<script[^>]*\bsrc="https?://[^>]*>.*?</script>|<script[^>]*>\s*import mermaid.*?</script>', re.DOTALL
)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """List the notebooks that the table of contents does not name at the end of its gallery."""
    gallery = next(part["Gallery"] for part in config.nav or [] if "Gallery" in part)
    gallery += [place for path in NOTEBOOKS if (place := f"gallery/{path.name}") not in gallery]
    return config


@event_priority(100)  # before the plugin that turns notebooks into pages
def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made or kept outside the folder of pages."""
    with warnings.catch_warnings(), ThreadPoolExecutor(available_cores()) as pool:
        warnings.simplefilter("ignore")  # Jupyter's own; threads cannot do so one by one
        # from the end: the longest, the paper's figures, begins first
        backwards = NOTEBOOKS[::-1]
        places = dict(zip((path.name for path in backwards), pool.map(kept, backwards), strict=True))
    pictures = {name: first_picture(place) for name, place in places.items()}
    for name, place in places.items():
        files.append(File(f"gallery/{name}", str(place.parent.parent), config.site_dir, config.use_directory_urls))
        if picture := pictures[name]:
            files.append(File.generated(config, f"gallery/{Path(name).stem}.png", content=picture))
    listed = next(part["Gallery"] for part in config.nav or [] if "Gallery" in part)
    pictured = {Path(place).name: bool(pictures[Path(place).name]) for place in listed[1:]}
    files.append(File.generated(config, "gallery/index.md", content=gallery(pictured)))
    for name, place in _KEPT_ELSEWHERE.items():
        files.append(File.generated(config, name, abs_src_path=str(ROOT / place)))
    files.append(File.generated(config, "commands.md", content=commands()))
    files.append(File.generated(config, "api.md", content=public_names()))
    return files


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Keep units, options and the program's name whole where lines break; names in cells of tables break at joints."""
    del page, config, files
    html = re.sub("(nm²?)/(µs)", "\\1/\u2060\\2", html)
    html = _CODE_IN_CELLS.sub(lambda code: _JOINT.sub("<wbr>", code[0]), html)
    return re.sub(
        r"(?<=<code>)[^<]*(?=</code>)", lambda code: _WHOLE.sub(r'<span class="whole">\g<0></span>', code[0]), html
    )


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Leave out what a page of a notebook would fetch from other machines; its links lead to the site's pages."""
    del config
    if not page.file.src_uri.endswith(".ipynb"):
        return output
    own = _FROM_AFAR.sub("", output)
    own = re.sub(r'href="(?:pages/)?(\w+)\.md"', r'href="../\1.html"', own)
    return re.sub(r'href="(\w+)\.ipynb"', r'href="\1.html"', own)


def first_picture(notebook: Path) -> bytes | None:
    """Return the first picture that a notebook shows, as PNG; None where it shows none."""
    for cell in nbformat.read(notebook, as_version=4).cells:
        for output in cell.get("outputs", []):
            if picture := output.get("data", {}).get("image/png"):
                return base64.b64decode(picture)
    return None


def gallery(pictured: dict[str, bool]) -> str:
    """Return the page of all notebooks, each with its picture if there is one, its title and its first sentence."""
    parts = ["# Gallery", _GALLERY, '<div class="gallery" markdown>']
    for name, has_picture in pictured.items():
        path = ROOT / "notebooks" / name
        title, _, text = nbformat.read(path, as_version=4).cells[0].source.partition("\n")
        sentence = re.split(r"(?<=[.?!])\s", re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", text.strip()), maxsplit=1)[0]
        picture = f"[![]({path.stem}.png)]({name})\n\n" if has_picture else ""
        words = f"[**{title.lstrip('# ')}**]({name})\n\n{' '.join(sentence.split())}"
        parts.append(f"<div markdown>\n\n{picture}{words}\n\n</div>")
    return "\n\n".join([*parts, "</div>"])


def commands() -> str:
    """Return the page of all commands, each with what `--help` prints."""
    top = click.Context(main, info_name="afm-jax", max_content_width=78, terminal_width=78, **main.context_settings)
    parts = ["# Commands", "What `afm-jax COMMAND --help` prints, command by command."]
    for name in main.list_commands(top):
        command = main.get_command(top, name)
        assert command is not None
        context = click.Context(command, info_name=name, parent=top, max_content_width=78, terminal_width=78)
        parts.append(f'## {name}\n\n<div class="help" markdown>\n\n```text\n{command.get_help(context)}\n```\n\n</div>')
    return "\n\n".join(parts)


def public_names() -> str:
    """Return the page of all public names, for mkdocstrings to fill in from their docstrings."""
    parts = ["# Python reference"]
    for package, title in ((afm_jax, "afm_jax: scenes and what becomes of them"), (fitting, "fitting: laws from data")):
        names = sorted(name for name in package.__all__ if not name.startswith("_") and name != "fitting")
        parts += [f"## {title}", *(f"::: {package.__name__}.{name}" for name in names)]
    return "\n\n".join(parts)
