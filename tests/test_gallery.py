"""The scenes of the gallery run, and its page shows them."""

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCENES = sorted((ROOT / "examples/gallery").glob("*.py"))


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_a_scene_draws_its_picture(path, tmp_path, monkeypatch):
    (tmp_path / "examples").symlink_to(ROOT / "examples", target_is_directory=True)
    (tmp_path / "docs/images/gallery").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(path), run_name="__main__")
    (picture,) = Path("docs/images/gallery").iterdir()
    assert picture.name == f"{path.stem}.png"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_page_shows_each_scene_once():
    page = (ROOT / "docs/gallery.md").read_text(encoding="utf-8")
    names = sorted(path.stem for path in SCENES)
    assert len(names) == 10
    assert sorted(re.findall(r"literalinclude\} \.\./examples/gallery/(\w+)\.py", page)) == names
    assert sorted(re.findall(r"images/gallery/(\w+)\.png", page)) == names
    assert all((ROOT / f"docs/images/gallery/{name}.png").is_file() for name in names)
