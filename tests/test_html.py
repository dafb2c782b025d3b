"""Pages, and what a browser makes of them; without Playwright and Chromium that part is skipped."""

import json
import re
import shutil
from pathlib import Path

import ibi_rs as ibi
import numpy as np
import pytest

pytest.importorskip("plotly")

SCENE = ibi.synth.outlier_layout(0, num_instances=5, num_correspondences=1000, num_points=256)
FOUND = ibi.register(SCENE.src, SCENE.tgt, SCENE.corr)
OUT = ibi.Rejected(np.eye(4), 0.21, "contradicted", 3, None)
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def with_rejected(found):
    data = ibi.Registration.from_dict(found.to_dict())
    data.rejected = (OUT,)
    return data


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("html") / "found.html"
    ibi.plot.html(SCENE.tgt, SCENE.src, with_rejected(FOUND), path, title="<b>bin</b> 3", unit="mm")
    return path


def held(path):
    text = path.read_text(encoding="utf-8")
    return text, json.loads(re.search(r'<script type="application/json" id="page">(.*?)</script>', text)[1])


def test_a_page_brings_all_that_it_needs(written):
    text, data = held(written)
    own = re.sub(r"(?s)<script[^>]*>.*?</script>", "", text)
    assert "http" not in own
    assert not re.search(r"<(?:script|link|img)[^>]*(?:src|href)=", text.partition("<main>")[0])
    assert "&lt;b&gt;bin&lt;/b&gt; 3" in own
    assert "<b>bin" not in own
    assert [pose["score"] for pose in data["poses"]] == [*(pose.score for pose in FOUND), 0.21]
    assert [pose["label"] for pose in data["poses"]] == ["0", "1", "2", "3", "4", "r0"]
    assert data["poses"][-1]["rejected"] == "contradicted"
    assert 4e6 < written.stat().st_size < 8e6


def test_a_page_of_a_large_scene_is_bounded(tmp_path):
    rng = np.random.default_rng(0)
    ibi.plot.html(rng.normal(size=(500_000, 3)), SCENE.src, FOUND, tmp_path / "large.html")
    assert (tmp_path / "large.html").stat().st_size < 8e6
    ibi.plot.html(SCENE.tgt, rng.normal(size=(500_000, 3)), FOUND, tmp_path / "parts.html")
    assert (tmp_path / "parts.html").stat().st_size < 12e6


def test_what_cannot_be_shown_is_refused(tmp_path):
    path = tmp_path / "a.html"
    with pytest.raises(ibi.InputError, match="tgt has 0 points"):
        ibi.plot.html([], SCENE.src, FOUND, path)
    with pytest.raises(ibi.InputError, match="src: there are 2 models; 1 were looked for"):
        ibi.plot.html(SCENE.tgt, [SCENE.src, SCENE.src], FOUND, path)
    with pytest.raises(ibi.InputError, match="unit is 'yd'"):
        ibi.plot.html(SCENE.tgt, SCENE.src, FOUND, path, unit="yd")
    assert not path.exists()


def test_nothing_found_is_a_page_too(tmp_path):
    found = ibi.register(SCENE.src, SCENE.tgt, SCENE.corr[:0])
    ibi.plot.html(SCENE.tgt, SCENE.src, found, tmp_path / "none.html")
    assert held(tmp_path / "none.html")[1] == {"poses": [], "scene": 0, "labels": None}


# In a browser --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def browser():
    api = pytest.importorskip("playwright.sync_api", reason="`make test-all` installs it")
    if CHROMIUM is None:
        pytest.skip("no Chromium")
    with api.sync_playwright() as play:
        # WebGL in software: there may be no graphics card.
        arguments = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        opened = play.chromium.launch(executable_path=CHROMIUM, args=arguments)
        yield opened
        opened.close()


def opened(browser, path: Path):
    context = browser.new_context(viewport={"width": 1200, "height": 800}, offline=True)
    context.set_default_timeout(300_000)
    page = context.new_page()
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(path.as_uri())
    page.wait_for_selector("body[data-ready=yes]")
    return page, errors


def shown(page):
    """The labels of what is to be seen, and the opacity of each."""
    script = "() => document.querySelector('.plotly-graph-div').data.map(t => [t.name, t.visible, t.opacity])"
    return {name: opacity for name, visible, opacity in page.evaluate(script) if visible is not False}


def test_a_page_is_worked_with(browser, written):
    page, errors = opened(browser, written)
    assert page.title() == "<b>bin</b> 3"
    assert page.locator("main canvas").count() > 0
    assert set(shown(page)) >= {"scene", "0", "1", "2", "3", "4"}
    assert "r0" not in shown(page)
    assert page.locator("li:visible").count() == 5

    page.check("#rejected")
    assert "r0" in shown(page)
    assert page.locator("li:visible").count() == 6
    page.uncheck("#scene")
    assert "scene" not in shown(page)

    page.fill("#number", "3")
    opacity = shown(page)
    assert opacity["3"] == 1
    assert max(opacity[name] for name in ("0", "1", "2", "4", "r0")) < 0.5
    assert f"{FOUND[3].score:.3f}" in page.inner_text("#facts")
    page.locator("li", has_text="r0").click()
    assert "contradicted" in page.inner_text("#facts")
    page.locator("li", has_text="r0").click()
    assert page.inner_text("#facts") == ""

    limit = (FOUND[2].score + FOUND[3].score) / 2
    page.fill("#least", f"{limit:.9f}")
    assert {name for name in shown(page) if name in list("01234")} == {"0", "1", "2"}
    assert errors == []


def test_a_page_of_nothing_is_worked_with(browser, tmp_path):
    found = ibi.register(SCENE.src, SCENE.tgt, SCENE.corr[:0])
    ibi.plot.html(SCENE.tgt, SCENE.src, found, tmp_path / "none.html")
    page, errors = opened(browser, tmp_path / "none.html")
    page.uncheck("#scene")
    assert "scene" not in shown(page)
    assert errors == []
