"""`ibi bop`: a tiny set of BOP from its folders to the scores."""

import csv
import json
import re
import shutil

import ibi_rs as ibi
import numpy as np
import pytest
import tiny_sets
from ibi_rs import datasets
from test_cli import run
from test_datasets import of_truth
from tiny_sets import PLACES


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tiny_sets.bop(tmp_path_factory.mktemp("sets") / "tiny")


@pytest.fixture(scope="module")
def found(root, tmp_path_factory):
    path = tmp_path_factory.mktemp("found") / "ibi_tiny-test.csv"
    return run("bop", root, "-o", path, "--jobs", 2), path


def scored(text):
    """What is printed, by name."""
    return {name: float(x) for name, x in re.findall(r"^(\w+(?: in mm)?) +([\d.]+)", text, re.MULTILINE)}


def test_a_data_set_is_found_and_scored(found):
    result, path = found
    assert result.exit_code == 0, result.output
    scores = scored(result.stdout)
    assert (scores["images"], scores["poses"], scores["targets"]) == (3, 5, 5)
    # All are found; how near to the truth is for others to say.
    assert scores["MHF1"] == 1
    assert min(scores["recall"], scores["AP in mm"]) > 0.8
    assert not path.with_name(f"{path.name}.journal").exists()


def test_the_csv_is_as_bop_wants_it(found):
    with found[1].open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["scene_id", "im_id", "obj_id", "score", "R", "t", "time"]
    times = {}
    for row in rows:
        assert row["time"] == times.setdefault((row["scene_id"], row["im_id"]), row["time"])
    # Millimetres: near the places where they were put.
    for (scene_id, im_id), held in PLACES.items():
        places = [place[:3, 3] for _, place, share in held if share > 0.1]
        own = [row for row in rows if (int(row["scene_id"]), int(row["im_id"])) == (scene_id, im_id)]
        told = np.array([np.fromstring(row["t"], sep=" ") for row in own])
        assert len(told) == len(places)
        assert all(np.linalg.norm(told - place, axis=1).min() < 3 for place in places)


def test_a_csv_of_the_truth_scores_1(root, tmp_path):
    datasets.write_bop_results(tmp_path / "truth_tiny-test.csv", of_truth())
    result = run("bop", root, "--score", tmp_path / "truth_tiny-test.csv")
    assert result.exit_code == 0
    scores = scored(result.stdout)
    assert (scores["recall"], scores["AP in mm"], scores["AP"], scores["seconds"]) == (1, 1, 1, 0.5)


def test_what_failed_is_told_and_done_with_the_next_run(root, found, tmp_path):
    broken = tmp_path / "tiny"
    shutil.copytree(root, broken)
    image = broken / "test/000001/depth/000004.png"
    whole = image.read_bytes()
    image.write_bytes(b"no image")
    path = tmp_path / "a.csv"
    result = run("bop", broken, "-o", path, "--jobs", 1)
    assert result.exit_code == 1
    assert f"ibi: 000001/000004: {image}: cannot be read" in result.stderr
    assert {(image.scene_id, image.im_id) for image in datasets.read_bop_results(path)} == {(1, 3), (2, 0)}
    journal = tmp_path / "a.csv.journal"
    with journal.open("a") as file:
        file.write('{"scene_id": 1, "im_id": 4, "obj')  # as a death in the middle of a line leaves it
    image.write_bytes(whole)
    for other in ("000001/depth/000003.png", "000002/depth/000000.png"):  # they are not read again
        (broken / "test" / other).write_bytes(b"no image")
    result = run("bop", broken, "-o", path, "--jobs", 1)
    assert result.exit_code == 0, result.output
    assert "ibi: 2 of 3 images are done already" in result.stderr
    assert not journal.exists()

    def without_time(text):
        return [line.rsplit(",", 1)[0] for line in text.splitlines()]

    assert without_time(path.read_text()) == without_time(found[1].read_text())


def test_with_other_options_a_journal_does_not_count(root, tmp_path):
    path, journal = tmp_path / "a.csv", tmp_path / "a.csv.journal"
    lines = [{"ibi_rs": ibi.__version__, "params": None}, {"scene_id": 1}]
    journal.write_text("\n".join(map(json.dumps, lines)))
    result = run("bop", root, "-o", path, "--jobs", 1, "--max-instances", 1, "--objects", 5)
    assert result.exit_code == 0
    assert "made with other dataset, models_sha256, voxel" not in result.stderr  # voxel is the same: none
    assert "a.csv.journal: made with other dataset, models_sha256, max_instances; all" in result.stderr
    assert {one for image in datasets.read_bop_results(path) for one in image.obj_ids} == {5}


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ((), 2, "give -o to make a CSV, or --score to score one"),
        (("-o", "a.csv", "--score", "b.csv"), 2, "give -o to make a CSV, or --score to score one"),
        (("-o", "a.csv", "--objects", "tee"), 2, "--objects tee: must be numbers"),
        (("-o", "a.csv", "--split", "val"), 1, "val: there is no such folder"),
        (("-o", "a.csv", "--camera", "cam1"), 1, "there is no camera 'cam1'"),
        (("--score", "none.csv"), 1, "none.csv: cannot be read: No such file"),
    ],
)
def test_what_is_wrong_is_one_line(root, tmp_path, monkeypatch, arguments, code, message):
    monkeypatch.chdir(tmp_path)
    result = run("bop", root, *arguments)
    assert result.exit_code == code
    assert message in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
