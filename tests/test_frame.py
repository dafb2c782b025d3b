"""What the benchmarks share: runs in turn, records, tables in pages, where results go."""

import sys
from functools import partial
from pathlib import Path

import ibi_rs as ibi
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from frame import cli, ours, records, runs, tables, timing
from frame.layouts import scene_of, scenes, seeds


def test_methods_run_in_turn_and_what_belongs_to_the_model_before():
    todo = list(scenes("outlier-10-50", "tuning", 2))
    calls = []

    def prepare(name, scene):
        calls.append(("prepare", name, scene.name))

        def register(scene):
            calls.append((name, scene.name))
            # The truth at first, nothing in the second repeat: scores are those of the first.
            return scene.poses if calls.count(calls[-1]) == 1 else scene.poses[:0]

        return register

    outcomes = runs.run(todo, {name: partial(prepare, name) for name in "ab"}, repeats=2)
    a, b = (scene.name for scene in todo)
    assert all(call[0] == "prepare" for call in calls[:4])
    assert calls[4:] == 2 * [("a", a), ("b", a), ("a", b), ("b", b)]
    for of in outcomes.values():
        assert [outcome.scene for outcome in of] == [a, b]
        assert [len(outcome.seconds) for outcome in of] == [2, 2]
        assert runs.mean(of).mhf1 == runs.mean(of, "strict").mhf1 == 1
        assert runs.num_poses(of) == runs.num_truths(of) == sum(scene.num_instances for scene in todo)


def test_several_processes_find_the_same():
    methods = {"default": partial(ours.prepare, params=ibi.Params(), num_threads=1)}
    make = partial(scene_of, "outlier-10-50", "tuning")
    here, there = (
        runs.run_each(make, list(seeds("outlier-10-50", "tuning", 3)), methods, jobs=jobs) for jobs in (1, 2)
    )
    clock = ("seconds", "ms")
    for a, b in zip(runs.rows(here), runs.rows(there), strict=True):
        assert {key: a[key] for key in a if key not in clock} == {
            key: b[key] for key in b if key not in clock
        }
    assert [row["method"] for row in runs.rows(here)] == 3 * ["default"]


def test_symmetric_shapes_have_no_strict_score():
    (scene,) = scenes("outlier-10-50", "tuning", 1)
    outcome = runs.score(scene, scene.poses, is_symmetric=True)
    assert outcome.strict is None
    assert outcome.one_to_one.f1 == outcome.any.f1 == 1


def test_a_record_has_the_columns_asked_for(tmp_path):
    rows = [{"a": 1, "b": 2, "c": 3}, {"a": 4}]
    records.write(tmp_path / "new", "some.csv", rows, ["b", "a"])
    assert records.read(tmp_path / "new/some.csv") == [{"b": "2", "a": "1"}, {"b": "", "a": "4"}]
    records.write(None, "none.csv", rows)
    assert records.read(tmp_path / "none.csv") == []


def test_a_page_keeps_all_but_the_tables_given():
    page = "x\n<!-- a -->\nold\n<!-- end -->\n<!-- b, c -->\nold\n<!-- end -->\ny"
    new = records.filled(page, {"b, c": "\\1 new", "absent": "z"})
    assert new == "x\n<!-- a -->\nold\n<!-- end -->\n<!-- b, c -->\n\\1 new\n<!-- end -->\ny"


def test_markdown_has_a_line_a_row():
    assert tables.markdown(("a", "b"), [(1, "x"), ("", 2.5)]) == "| a | b |\n|---|---|\n| 1 | x |\n|  | 2.5 |"


@pytest.mark.parametrize(
    ("given", "keeps"),
    [
        ([], True),
        (["--scenes", "3"], False),
        (["--half", "tuning"], False),
        (["--repeats", "1"], True),
        (["--docs"], True),
    ],
)
def test_only_what_is_usual_goes_to_the_repository(given, keeps, monkeypatch, tmp_path):
    options = (cli.HALF, cli.scenes(10), cli.repeats(3), cli.flag("--docs", "docs"), cli.out("repeats"))
    monkeypatch.setattr(sys, "argv", ["bench", *given])
    args = cli.parse("Asks.", *options)
    assert args.usual == keeps
    usual = (records.RECORDS, records.FIGURES) if keeps else (None, None)
    assert (args.records, args.pictures) == usual
    monkeypatch.setattr(sys, "argv", ["bench", *given, "--out", str(tmp_path)])
    args = cli.parse("Asks.", *options)
    assert (args.usual, args.records, args.pictures) == (keeps, tmp_path, tmp_path)


def test_layouts_of_modelnet_need_its_clouds(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["bench"])
    args = cli.parse("Asks.", cli.LAYOUT, cli.MODELNET)
    assert cli.layouts(args, ("fpfh", "fpfh-modelnet")) == ["fpfh"]
    monkeypatch.setattr(sys, "argv", ["bench", "--layout", "fpfh-modelnet"])
    with pytest.raises(SystemExit):
        cli.layouts(cli.parse("Asks.", cli.LAYOUT, cli.MODELNET), ("fpfh",))
    assert "ModelNet layouts need --modelnet" in capsys.readouterr().err


def test_the_exponent_is_that_of_the_power():
    x = np.array([1.0, 3, 10, 40])
    assert timing.exponent(x, 5 * x**1.5) == pytest.approx((1.5, 5))


def test_jobs_alternate():
    calls = []
    seconds = timing.in_turn([lambda: calls.append("a"), lambda: calls.append("b")], 3)
    assert calls == 3 * ["a", "b"]
    assert seconds.shape == (3, 2)
    assert np.all(seconds >= 0)


def test_the_page_of_accuracy_is_what_the_record_says():
    import accuracy_mm

    text = accuracy_mm.table(records.read(records.RECORDS / "covariance.csv"))
    page = (records.DOCS / "accuracy.md").read_text(encoding="utf-8")
    assert records.filled(page, {"accuracy": text}) == page
    assert text in page


def test_accuracy_is_summed_up_by_part():
    import accuracy_mm

    rows = [
        {"where": "bin", "part": part, "shift_mm": shift, "turn_deg": turn}
        for part, shift, turn in (("a", "0.5", "1"), ("a", "1.5", "1"), ("b", "0.5", "3"))
    ]
    lines = accuracy_mm.table(rows).splitlines()[2:]
    assert lines[0] == "| in a bin | a | 2 | 1.00 | 1.45 | 1.00 | 1.00 | 0.50 |"
    assert lines[1] == "| in a bin | b | 1 | 0.50 | 0.50 | 3.00 | 3.00 | 0.00 |"
    assert lines[2].startswith("| in a bin | all | 3 | 0.50 |")
