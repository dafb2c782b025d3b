"""What is written is whole or not there; numbers are written as people read them."""

import errno
import json
import os

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import _files, _numbers, cli
from test_viz import NO_RERUN

SCENE = ibi.synth.outlier_layout(0, num_instances=2, num_correspondences=300, num_points=128)
FOUND = ibi.register(SCENE.src, SCENE.tgt, SCENE.corr)


def recording(path):
    pytest.importorskip("rerun", reason=NO_RERUN)
    ibi.viz.record(SCENE.tgt, SCENE.src, FOUND, path)


WRITERS = {
    "poses.json": lambda path: cli.outputs.write_json(path, {"poses": []}),
    "poses.csv": lambda path: cli.outputs.write_bop(
        path, [(0, 0, np.asarray(FOUND), [1.0, 1.0], 0.1)], mm=1.0
    ),
    "found.png": lambda path: ibi.plot.instances(SCENE.tgt, SCENE.src, FOUND, path),
    "found.pdf": lambda path: ibi.plot.instances(SCENE.tgt, SCENE.src, FOUND, path),
    "found.rrd": recording,
    "params.toml": ibi.Params().save,
    "params.json": ibi.Params().save,
}
each_writer = pytest.mark.parametrize("name", WRITERS)


@each_writer
def test_a_file_is_written_and_nothing_beside_it(name, tmp_path):
    WRITERS[name](tmp_path / name)
    assert os.listdir(tmp_path) == [name]
    assert (tmp_path / name).stat().st_size > 10


@each_writer
@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_what_cannot_be_finished_leaves_what_was_there(name, error, tmp_path, monkeypatch):
    def full(source, target):
        assert os.stat(source).st_size > 10  # it was written
        raise error

    monkeypatch.setattr(os, "replace", full)
    for before in ([], [name]):
        for old in before:
            (tmp_path / old).write_text("old")
        with pytest.raises(type(error)):
            WRITERS[name](tmp_path / name)
        assert os.listdir(tmp_path) == before
    assert (tmp_path / name).read_text() == "old"


@each_writer
def test_a_folder_that_is_not_there_is_an_error_that_names_the_file(name, tmp_path):
    path = tmp_path / "nowhere" / name
    with pytest.raises(OSError, match="nowhere") as caught:
        WRITERS[name](path)
    assert caught.value.filename == str(path)
    with pytest.raises(ibi.InputError, match="there is no folder"):
        _files.try_writing(path)


def test_an_error_in_between_leaves_nothing(tmp_path):
    def broken(kind):
        with _files.written(tmp_path / "a.txt") as part:
            part.write_text("half")
            raise kind

    for kind in (ValueError, KeyboardInterrupt, MemoryError, SystemExit):
        with pytest.raises(kind):
            broken(kind)
        assert os.listdir(tmp_path) == []


def test_links_modes_and_pipes_stay_what_they_are(tmp_path):
    real, link, pipe = (tmp_path / name for name in ("real", "link", "pipe"))
    real.write_text("old")
    real.chmod(0o640)
    link.symlink_to(real)
    with _files.written(link) as part:
        part.write_text("new")
    assert link.is_symlink()
    assert real.read_text() == "new"
    assert real.stat().st_mode & 0o777 == 0o640
    os.mkfifo(pipe)
    _files.try_writing(pipe)
    with _files.written(pipe) as part:
        assert part == pipe  # else it would be replaced by a file, as would /dev/null
    assert sorted(os.listdir(tmp_path)) == ["link", "pipe", "real"]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (".", "is a folder; give the name of a file"),
        ("no/where.json", "there is no folder"),
        ("file/poses.json", "there is no folder"),
        ("x" * 300, "File name too long"),
        ("x" * 253, "File name too long"),
    ],
)
def test_an_output_is_tried_without_a_trace(name, message, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises((ibi.InputError, OSError), match=message):
        _files.try_writing(tmp_path / name)
    _files.try_writing(tmp_path / "new")
    assert os.listdir(tmp_path) == ["file"]


def test_what_must_not_be_written_is_refused(tmp_path, monkeypatch):
    """The system is asked, and its answer given here: root may write everywhere."""

    def refuse(**options):
        raise PermissionError(13, "Permission denied")

    (tmp_path / "old").touch()
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(ibi.InputError, match="old: must not be written"):
        _files.try_writing(tmp_path / "old")
    monkeypatch.setattr(_files.tempfile, "TemporaryFile", refuse)
    with pytest.raises(ibi.InputError, match="new: cannot be written: Permission denied"):
        _files.try_writing(tmp_path / "new")


@pytest.mark.parametrize("path", ["found", "found.bad", "found.pgf", "found.png.bad", "."])
def test_a_picture_of_no_known_kind_is_refused(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ibi.InputError, match=r"pictures are written as .*pdf, png"):
        ibi.plot.instances(SCENE.tgt, SCENE.src, FOUND, path)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tgt": np.empty((0, 3))}, "tgt has 0 points"),
        ({"src": [[1, 2]]}, "src has shape"),
        ({"registration": np.eye(4)}, r"registration has shape \(4, 4\)"),
        ({"registration": np.zeros(16)}, r"registration has shape \(16,\)"),
        ({"turns_deg": ()}, "turns_deg is empty"),
    ],
)
def test_what_cannot_be_drawn_is_named(options, message):
    with pytest.raises(ibi.InputError, match=f"^{message}"):
        ibi.plot.instances(**{"tgt": SCENE.tgt, "src": SCENE.src, "registration": FOUND, **options})


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, "\xff", None])
def test_what_is_no_json_is_named(text, tmp_path):
    path = tmp_path / "bad.json"
    if text is None:
        path.mkdir()
    else:
        path.write_text(text, encoding="latin-1")
    with pytest.raises(ibi.InputError) as caught:
        _files.read_json(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


# Numbers -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "scale", "text"),
    [
        (500123.267, 2.3, "500123.27"),
        (500123.267, 0.0023, "500123.26700"),
        (500123.267, 230, "500123"),
        (-0.0001, 2.3, "0.00"),
        (0.7310789, 0.002562, "0.73108"),
        (12.5, 0.0, "12.5000"),
        (12.5, float("nan"), "12.5000"),
        (1e-20, 1e-20, "1e-20"),
        (1e30, 1.0, "1e+30"),
        (float("nan"), 1.0, "nan"),
        (float("-inf"), 1.0, "-inf"),
    ],
)
def test_lengths_have_the_decimals_that_mean_something(value, scale, text):
    assert _numbers.lengths([value], scale) == [text]


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.00256234, "0.002562"), (123456.7, "123457"), (0.0, "0"), (12345, "12345"), (1e300, "1e+300")],
)
def test_numbers_have_as_many_digits_as_count(value, text):
    assert _numbers.significant(value) == text


def test_far_from_the_origin_no_digit_is_lost():
    """In map coordinates %.4g would print 5.001e+05."""
    far = np.array([500123.267, 4600456.125, 0])
    found = ibi.register(SCENE.src, SCENE.tgt + far, SCENE.corr)
    assert len(found) > 0
    shown = [*repr(found).splitlines()[1:], *map(repr, found)]
    for line, pose in zip(shown, [*found, *found], strict=True):
        place = json.loads(line[line.index("[") : line.index("]") + 1])
        np.testing.assert_allclose(place, pose.target_from_source[:3, 3], atol=0.01 * found.resolution)
    assert "e+" not in repr(found)
    assert repr(ibi.View(far, SCENE.tgt)).endswith("from [500123.267, 4600456.125, 0])")
    assert "e+" not in repr(ibi.Model(1e6 * SCENE.src))


def test_numbers_of_many_parts_do_not_cover_each_other():
    centres = np.random.default_rng(0).uniform(0, 100, (80, 2))
    centres[40:50] = centres[0]  # one above the other
    places = ibi.plot._apart(centres, 8.0)
    gaps = np.linalg.norm(places[:, None] - places, axis=2) + np.diag(np.full(80, np.inf))
    assert gaps.min() >= 8.0
    # What is free stays where it is.
    alone = np.array([[0.0, 0.0], [50.0, 0.0], [0.0, 50.0]])
    np.testing.assert_array_equal(ibi.plot._apart(alone, 8.0), alone)
    assert ibi.plot._apart(np.empty((0, 2)), 8.0).shape == (0, 2)
