"""Parameters: the core's defaults, every way in and out, and what is refused."""

import ast
import copy
import inspect
import json
import pickle
import re
import sys
from dataclasses import FrozenInstanceError, asdict, fields
from pathlib import Path
from typing import get_args

import ibi_rs as ibi
import numpy as np
import pytest
from ibi_rs import _core
from ibi_rs.params import Preset, Removal
from ibi_rs.variants import Ce, Hv, Scs, Te

STAGES = ("scs", "ce", "te", "hv")
VARIANTS = {name: get_args(union) or (union,) for name, union in zip(STAGES, (Scs, Ce, Te, Hv), strict=True)}
EACH_VARIANT = [(stage, variant) for stage, variants in VARIANTS.items() for variant in variants]

PLAIN = ibi.Params()
OTHER = ibi.Params(
    seed=2**64 - 1,
    resolution=0.05,
    delta_r_pr=1 / 3,
    t_he_pr=2.5,
    d_op_pr=2,
    t_s=7,
    scs=ibi.Gtm(n_downsample=500, n_gtm=30, payoff="ratio"),
    ce=ibi.Off(),
    te=ibi.Ransac(n_ransac=5000, min_height_pr=0),
    hv=ibi.InlierCount(t_inliers=100),
    removal=get_args(Removal)[0],
    max_rounds=9,
    max_instances=0,
    timeout_s=1e-3,
)
# None where the default is a number, and the other way round.
UNLIMITED = ibi.Params(
    min_normal_cos=None,
    oriented_normals=True,
    scs=ibi.LocalGtm(second_order=False, normal_tolerance=2),
    hv=ibi.Evidence(t_score=0.01, exclusive=False),
    refine="none",
    n_contest=1,
    joint_check=False,
    max_rejections=None,
    max_rounds=10,
    timeout_s=5,
)
SETTINGS = {
    "default": PLAIN,
    "other": OTHER,
    "unlimited": UNLIMITED,
    "paper_synthetic": ibi.Params.paper_synthetic(),
    "paper_real": ibi.Params.paper_real(),
    "single_view": ibi.Params.single_view(),
    "many_views": ibi.Params.many_views(),
}
each_setting = pytest.mark.parametrize("params", SETTINGS.values(), ids=SETTINGS)


# Defaults ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["default", "paper_synthetic", "paper_real", "single_view", "many_views"])
def test_presets_are_those_of_the_core(name):
    assert SETTINGS[name].to_dict() == json.loads(_core.preset(name))


def test_defaults_are_those_of_the_core():
    """Read from the fields, before any check could complete them."""
    core = json.loads(_core.preset("default"))
    assert [f.name for f in fields(ibi.Params)] == list(core)
    for f in fields(ibi.Params):
        value = f.default
        if f.name in VARIANTS:
            value = {"variant": value.variant, **asdict(value)}
        assert value == core[f.name], f.name


@pytest.mark.parametrize(("stage", "variant"), EACH_VARIANT)
def test_defaults_of_each_variant_are_those_of_the_core(stage, variant):
    core = json.loads(_core.check_params(json.dumps({stage: {"variant": variant.variant}})))
    assert {"variant": variant.variant, **asdict(variant())} == core[stage]


ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "docs"))
import variants as written  # noqa: E402

PARAMETERS = list(written.parameters())


def core_docs():
    """What the core's source says of each field of each variant."""
    for path in (ROOT / "crates/ibi-core/src/stages").rglob("*.rs"):
        for name, body in re.findall(
            r"^pub struct (\w+) \{\n(.*?)^\}", path.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
        ):
            for doc, field in re.findall(r"((?:    ///.*\n)+)(?:    (?:#|//) ?.*\n)*    pub (\w+):", body):
                yield (name, field), " ".join(doc.replace("///", "").split())


def plain(text):
    """Without markup."""
    return text.replace("`", "")


def test_what_a_parameter_means_is_said_in_the_core_first():
    said = dict(core_docs())
    names = {variant.variant: variant.__name__.rstrip("_") for _, variant in EACH_VARIANT}
    for path, variant, _, meaning in PARAMETERS:
        core = plain(said[names[variant], path.partition(".")[2]])
        assert plain(meaning).startswith(core), f"{path} of {variant}"


def test_the_page_has_the_parameters_of_the_variants():
    assert written.page() == written.PAGE.read_text(encoding="utf-8"), "run docs/variants.py"


def ends(meaning):
    """Values within a range, as it is written, and values without."""
    number = r"(\d[\d,]*)"
    if found := re.search(rf"\b{number} to {number}\b", meaning):
        low, high = (int(text.replace(",", "")) for text in found.groups())
        return (low, high), (low - 1, high + 1)
    if found := re.search(rf"\bAt least {number}\b", meaning):
        return (int(found[1]),), (int(found[1]) - 1,)
    if ">= 0" in meaning:
        return (0, 1e9), (-1e-6, 1e10)
    if "> 0" in meaning:
        return (1e-9, 1e9), (0, -1, 1e10)
    return (), ()


@pytest.mark.parametrize("parameter", PARAMETERS, ids=lambda p: f"{p.variant}-{p.path}")
def test_a_range_is_what_the_core_takes(parameter):
    path, variant, default, meaning = parameter
    stage, _, name = path.partition(".")
    within, without = ends(meaning)
    assert within or isinstance(default, (bool, str))

    def check(value):
        _core.check_params(json.dumps({stage: {"variant": variant, name: value}}))

    for value in within:
        check(value)
    for value in without:
        with pytest.raises(ibi.ParamsError):
            check(value)


def test_the_core_knows_no_further_variant():
    for stage, variants in VARIANTS.items():
        with pytest.raises(ibi.ParamsError) as caught:
            _core.check_params(json.dumps({stage: {"variant": "?"}}))
        expected = str(caught.value).partition("expected ")[2]
        assert expected.count("`") == 2 * len(variants)
        assert all(f"`{variant.variant}`" in expected for variant in variants)


def test_the_default_is_not_the_paper():
    """Each parameter in which it departs; docs/paper-map.md lists them."""
    paper = ibi.Params.paper_synthetic()
    departs = {f.name for f in fields(PLAIN) if getattr(PLAIN, f.name) != getattr(paper, f.name)}
    lengths = {"delta_r_pr", "t_he_pr"}
    assert departs == lengths | {
        *("min_normal_cos", "t_s", "scs", "te", "hv", "refine"),
        *("n_contest", "joint_check", "removal", "max_rejections"),
    }
    assert (PLAIN.scs, PLAIN.te, PLAIN.hv) == (ibi.LocalGtm(), ibi.Irls(), ibi.Evidence())
    assert PLAIN.d_op_pr == paper.d_op_pr


def test_the_paper_knows_no_additions():
    for paper in (ibi.Params.paper_synthetic(), ibi.Params.paper_real()):
        assert (paper.refine, paper.n_contest, paper.removal) == ("none", 1, "dense")
        assert (paper.joint_check, paper.min_normal_cos, paper.max_rejections) == (False, None, None)


# There and back ------------------------------------------------------------------------------------------


@each_setting
def test_dict_json_and_toml_lead_back(params):
    assert ibi.Params.from_dict(params.to_dict()) == params
    assert ibi.Params.from_dict(json.loads(json.dumps(params.to_dict()))) == params
    assert ibi.Params.from_toml(params.to_toml()) == params


def test_toml_says_none_by_a_word():
    """It has no null, and what it leaves out takes its default, which need not be None."""
    text = UNLIMITED.to_toml()
    for name in ("resolution", "min_normal_cos", "max_rejections", "max_instances"):
        assert f'\n{name} = "none"\n' in f"\n{text}"
        assert getattr(ibi.Params.from_toml(f'{name} = "none"'), name) is None
    assert ibi.Params.from_toml('max_rejections = "none"') == PLAIN.replace(max_rejections=None)
    assert ibi.Params.from_toml("max_rejections = 7\nmin_normal_cos = 0.5\ntimeout_s = 2") == PLAIN.replace(
        max_rejections=7, min_normal_cos=0.5, timeout_s=2
    )
    assert json.loads(json.dumps(UNLIMITED.to_dict()))["max_rejections"] is None


@each_setting
@pytest.mark.parametrize("name", ["params.toml", "params.json"])
def test_files_lead_back(params, name, tmp_path):
    params.save(tmp_path / name)
    assert ibi.Params.load(tmp_path / name) == params
    assert ibi.Params.load(str(tmp_path / name)) == params


@each_setting
def test_copies_are_equal(params):
    for twin in (pickle.loads(pickle.dumps(params)), copy.deepcopy(params), params.replace()):
        assert twin == params
        assert hash(twin) == hash(params)
    assert eval(repr(params), vars(ibi)) == params


def test_what_is_left_out_is_defaulted():
    assert ibi.Params.from_dict({}) == ibi.Params.from_toml("") == PLAIN
    assert ibi.Params.from_dict({"t_s": 6}) == ibi.Params.from_toml("t_s = 6") == ibi.Params(t_s=6)
    block = {"te": {"variant": "ransac", "n_ransac": 50}}
    params = ibi.Params(te=ibi.Ransac(n_ransac=50))
    assert ibi.Params.from_dict(block) == params
    assert ibi.Params.from_toml('[te]\nvariant = "ransac"\nn_ransac = 50') == params


# As values -----------------------------------------------------------------------------------------------


def test_words_stand_for_stages():
    for stage, variant in EACH_VARIANT:
        params = ibi.Params(**{stage: variant.variant})
        assert params == ibi.Params(**{stage: variant()})
        assert getattr(params, stage) == variant()
        assert PLAIN.replace(**{stage: variant.variant}) == params
        assert ibi.Params.from_dict({stage: variant.variant}) == params
        for quoted in (f"'{variant.variant}'", f'"{variant.variant}"', f'"""{variant.variant}"""'):
            assert ibi.Params.from_toml(f"t_s = 4\n{stage} = {quoted} # that") == params
    words = 'te = "mac"\nscs = "gtm"\nhv="none"\n[ce]\nvariant = "off"'
    assert ibi.Params.from_toml(words) == ibi.Params(te="mac", scs="gtm", hv="none", ce="off")


def test_params_are_frozen_values():
    assert ibi.Params(t_s=6) == ibi.Params(t_s=6) != PLAIN
    assert ibi.Params(ce="off") != PLAIN
    assert {PLAIN: "a", ibi.Params(t_s=4): "b"} == {PLAIN: "b"}
    for frozen, name in ((PLAIN, "t_s"), (PLAIN.scs, "n_gtm"), (PLAIN.hv, "t_score")):
        with pytest.raises(FrozenInstanceError):
            setattr(frozen, name, 9)


def test_replace_leaves_the_original():
    assert PLAIN.replace(t_s=6, hv="none") == ibi.Params(t_s=6, hv=ibi.None_())
    assert PLAIN.t_s == 4
    with pytest.raises(TypeError, match="t_z"):
        PLAIN.replace(t_z=6)


SURE = {"hv": {"t_score": 0.97}}


def test_one_value_is_changed_and_its_block_stays():
    for before in (ibi.Params.single_view(), OTHER.replace(hv=ibi.Evidence(t_score=0.1, t_sure=0.3))):
        after = before.replace(hv={"t_score": 0.97})
        assert after == before.replace(**{"hv.t_score": 0.97})
        wanted = before.to_dict()
        wanted["hv"]["t_score"] = 0.97
        assert after.to_dict() == wanted


def test_several_values_of_several_blocks_are_changed():
    after = PLAIN.replace(
        t_s=5, te={"variant": "mac"}, **{"te.t_cmp": 0.5, "hv.t_sure": 0.7, "hv.t_score": 0.6}
    )
    assert after == ibi.Params(t_s=5, te=ibi.Mac(t_cmp=0.5), hv=ibi.Evidence(t_sure=0.7, t_score=0.6))
    assert PLAIN.replace(te="mac", **{"te.t_cmp": 0.5}) == ibi.Params(te=ibi.Mac(t_cmp=0.5))
    mac = ibi.Mac(t_sog=0.1)
    assert PLAIN.replace(te=mac, **{"te.t_cmp": 0.5}).te == ibi.Mac(t_sog=0.1, t_cmp=0.5)
    # Another variant has nothing of the one before.
    assert PLAIN.replace(hv={"variant": "overlap"}).hv == ibi.Overlap()


def test_a_value_of_another_variant_is_refused():
    with pytest.raises(ibi.ParamsError, match="t_overlap"):
        PLAIN.replace(hv={"t_overlap": 0.5})
    with pytest.raises(TypeError, match="hw"):
        PLAIN.replace(**{"hw.t_score": 0.5})
    with pytest.raises(ibi.ParamsError, match=r"params\.te names no variant"):
        ibi.Params(te=lambda context: None).replace(te={"n_gsac": 5})


@pytest.mark.parametrize("name", get_args(Preset))
def test_what_is_left_out_is_of_the_base(name):
    preset = ibi.Params.preset(name)
    assert preset == SETTINGS[name]
    changes = {"base": name, "t_s": 7, "max_rejections": None, "hv": {"variant": "evidence", "t_score": 0.97}}
    if preset.hv.variant == "evidence":
        wanted = preset.replace(t_s=7, max_rejections=None, hv={"t_score": 0.97})
    else:
        wanted = preset.replace(t_s=7, max_rejections=None, hv=ibi.Evidence(t_score=0.97))
    assert ibi.Params.from_dict(changes) == wanted
    text = f'base = "{name}"\nt_s = 7\nmax_rejections = "none"\nhv = {{variant = "evidence", t_score = 0.97}}'
    assert ibi.Params.from_toml(text) == wanted
    without = {key: value for key, value in changes.items() if key != "base"}
    assert ibi.Params.from_dict(without, base=preset) == wanted
    assert ibi.Params.from_toml(text.partition("\n")[2], base=preset) == wanted
    # What the data name comes before the argument.
    assert ibi.Params.from_dict(changes, base=OTHER) == wanted


def test_a_file_has_a_base(tmp_path):
    for name, text in (
        ("a.toml", 'base = "single_view"\n[hv]\nt_score = 0.97'),
        ("a.json", json.dumps({"base": "single_view", **SURE})),
    ):
        (tmp_path / name).write_text(text)
        assert ibi.Params.load(tmp_path / name) == ibi.Params.single_view().replace(**SURE)
        (tmp_path / name).write_text(text.replace("single_view", "singel"))
        with pytest.raises(ibi.ParamsError, match=f"{name}: params.base is 'singel'; it must be one of"):
            ibi.Params.load(tmp_path / name)
    # A base of one's own fits all that is complete, too.
    OTHER.save(tmp_path / "whole.toml")
    assert ibi.Params.load(tmp_path / "whole.toml", base=ibi.Params.single_view()) == OTHER


def test_a_type_checker_is_told_of_the_same_arguments():
    """Of `__init__` there are two: the dataclass's own, and the one that a type checker reads."""
    tree = ast.parse(inspect.getsource(sys.modules[ibi.Params.__module__]))
    (told,) = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name == "__init__"]
    names = [argument.arg for argument in told.args.kwonlyargs]
    assert names == [f.name for f in fields(ibi.Params)]
    for f, default in zip(fields(ibi.Params), told.args.kw_defaults, strict=True):
        assert eval(ast.unparse(default), vars(ibi)) == f.default, f.name
    words = {
        stage: get_args(getattr(sys.modules[ibi.Params.__module__], f"{stage.title()}Word"))
        for stage in STAGES
    }
    assert words == {stage: tuple(v.variant for v in VARIANTS[stage]) for stage in STAGES} | {
        "hv": ("evidence", "overlap", "inlier_count", "none")
    }


def test_numbers_become_plain_ones():
    params = ibi.Params(
        seed=np.int16(3), t_he_pr=np.float32(0.5), t_s=np.array(6), d_op_pr=2, scs=ibi.Gtm(n_gtm=np.uint8(9))
    )
    assert params == ibi.Params(seed=3, t_he_pr=0.5, t_s=6, d_op_pr=2.0, scs=ibi.Gtm(n_gtm=9))
    values = (params.seed, params.t_he_pr, params.t_s, params.d_op_pr, params.scs.n_gtm)
    assert [type(value) for value in values] == [int, float, int, float, int]


def test_a_subclass_stays_one():
    class Mine(ibi.Params):
        pass

    made = (Mine(), Mine.paper_real(), Mine.from_dict({}), Mine.from_toml(""), Mine().replace(t_s=6))
    assert {type(params) for params in made} == {Mine}


# Refused -------------------------------------------------------------------------------------------------

NAN, INF = float("nan"), float("inf")
FLOAT, INT = "it must be a finite number", "it must be an integer from 0 to"
BOOL = "it must be True or False"

# Arguments, and what the message must begin with.
REFUSED = [
    ({"seed": -1}, f"params.seed is -1; {INT} 18446744073709551615"),
    ({"seed": 2**64}, f"params.seed is 18446744073709551616; {INT}"),
    ({"seed": 1.0}, f"params.seed is 1.0; {INT}"),
    ({"seed": "1"}, f"params.seed is '1'; {INT}"),
    ({"seed": None}, f"params.seed is None; {INT}"),
    ({"seed": np.arange(3)}, f"params.seed is array([0, 1, 2]); {INT}"),
    ({"seed": np.eye(9)}, "params.seed is array([[1., 0., 0.,"),
    ({"resolution": 0}, "params.resolution is 0; it must be between 1e-9 and 1e9"),
    ({"resolution": NAN}, f"params.resolution is nan; {FLOAT}"),
    ({"delta_r_pr": 0}, "params.delta_r_pr is 0; it must be between"),
    ({"delta_r_pr": "10"}, f"params.delta_r_pr is '10'; {FLOAT}"),
    ({"t_he_pr": -3}, "params.t_he_pr is -3; it must be between"),
    ({"t_he_pr": INF}, f"params.t_he_pr is inf; {FLOAT}"),
    ({"t_he_pr": 10**400}, "params.t_he_pr is 1000000"),
    ({"t_he_pr": np.float32(NAN)}, f"params.t_he_pr is nan; {FLOAT}"),
    ({"d_op_pr": None}, f"params.d_op_pr is None; {FLOAT}"),
    ({"d_op_pr": 1j}, f"params.d_op_pr is 1j; {FLOAT}"),
    ({"min_normal_cos": 1.5}, "params.min_normal_cos is 1.5; it must be between -1 and 1"),
    ({"min_normal_cos": "none"}, f"params.min_normal_cos is 'none'; {FLOAT}"),
    ({"oriented_normals": 1}, f"params.oriented_normals is 1; {BOOL}"),
    ({"oriented_normals": None}, f"params.oriented_normals is None; {BOOL}"),
    ({"t_s": 2}, "params.t_s is 2; it must be at least 3"),
    ({"t_s": 5.5}, f"params.t_s is 5.5; {INT}"),
    ({"t_s": True}, f"params.t_s is True; {INT}"),
    ({"refine": "off"}, "params.refine is 'off'; it must be one of 'none', 'icp'"),
    ({"n_contest": 0}, "params.n_contest is 0; it must be at least 1"),
    ({"joint_check": "yes"}, f"params.joint_check is 'yes'; {BOOL}"),
    ({"refine": np.array(["icp", "none"])}, "params.refine is array(['icp', 'none']"),
    ({"scs": ibi.Gtm(payoff=np.array([1, 2]))}, "params.scs.payoff is array([1, 2]); it must be one of"),
    ({"removal": "all"}, "params.removal is 'all'; it must be one of 'dense'"),
    ({"max_rejections": -1}, f"params.max_rejections is -1; {INT}"),
    ({"max_rejections": "none"}, f"params.max_rejections is 'none'; {INT}"),
    ({"max_rounds": -1}, f"params.max_rounds is -1; {INT}"),
    ({"max_instances": 2**32}, f"params.max_instances is 4294967296; {INT}"),
    ({"timeout_s": -1}, "params.timeout_s is -1; it must be between 0 and 1e9 seconds"),
    ({"timeout_s": INF}, f"params.timeout_s is inf; {FLOAT}"),
    ({"scs": "gmt"}, "params.scs is 'gmt'; it must be one of 'gtm'"),
    ({"scs": None}, "params.scs is None; it must be one of Gtm()"),
    ({"ce": "none"}, "params.ce is 'none'; it must be one of 'voting', 'off'"),
    ({"ce": ibi.Gtm()}, "params.ce is Gtm("),
    ({"te": ibi.Gsac}, "params.te is <class 'ibi_rs.variants.Gsac'>; it must be one of Gsac(), "),
    ({"hv": "off"}, "params.hv is 'off'; it must be one of 'evidence', 'overlap', 'inlier_count', 'none'"),
    ({"scs": ibi.Gtm(n_downsample=2)}, "params.scs.n_downsample is 2; it must be at least 3"),
    ({"scs": ibi.Gtm(n_downsample=16385)}, "params.scs.n_downsample is 16385; it must be at most 16384"),
    ({"scs": ibi.Gtm(n_gtm=0)}, "params.scs.n_gtm is 0; it must be at least 1"),
    (
        {"scs": ibi.Gtm(payoff="linear")},
        "params.scs.payoff is 'linear'; it must be one of 'gaussian', 'ratio'",
    ),
    ({"scs": ibi.LocalGtm(tau_pr=0)}, "params.scs.tau_pr is 0; it must be between 1e-9 and 1e9"),
    ({"scs": ibi.LocalGtm(min_length_pr=-1)}, "params.scs.min_length_pr is -1; it must be 0 or between"),
    ({"scs": ibi.LocalGtm(normal_tolerance=0)}, "params.scs.normal_tolerance is 0; it must be between"),
    ({"scs": ibi.LocalGtm(second_order=0)}, f"params.scs.second_order is 0; {BOOL}"),
    ({"scs": ibi.Nnsr(n_nnsr=2)}, "params.scs.n_nnsr is 2; it must be at least 3"),
    ({"scs": ibi.Hough3d(bin_pr=0)}, "params.scs.bin_pr is 0; it must be between 1e-9 and 1e9"),
    ({"scs": ibi.Hough3d(frame_radius_pr=-1)}, "params.scs.frame_radius_pr is -1; it must be between"),
    ({"ce": ibi.Voting(n_vot=2)}, "params.ce.n_vot is 2; it must be at least 3"),
    ({"ce": ibi.Voting(n_vot=300.5)}, f"params.ce.n_vot is 300.5; {INT}"),
    ({"te": ibi.Gsac(n_gsac=0)}, "params.te.n_gsac is 0; it must be at least 1"),
    ({"te": ibi.Gsac(min_height_pr=-1)}, "params.te.min_height_pr is -1; it must be 0 or between"),
    ({"te": ibi.Ransac(n_ransac=0)}, "params.te.n_ransac is 0; it must be at least 1"),
    ({"te": ibi.Ransac(n_ransac=10**7 + 1)}, "params.te.n_ransac is 10000001; it must be at most 10,000,000"),
    ({"te": ibi.Ransac(n_ransac=None)}, f"params.te.n_ransac is None; {INT}"),
    ({"te": ibi.Irls(n_refits=0)}, "params.te.n_refits is 0; it must be at least 1"),
    ({"te": ibi.Irls(n_refits=1001)}, "params.te.n_refits is 1001; it must be at most 1000"),
    ({"te": ibi.SacCot(n_sac_cot=0)}, "params.te.n_sac_cot is 0; it must be at least 1"),
    ({"te": ibi.SacCot(t_cmp=1.5)}, "params.te.t_cmp is 1.5; it must be between 0 and 1"),
    ({"te": ibi.SacCot(max_triangles=0)}, "params.te.max_triangles is 0; it must be at least 1"),
    ({"te": ibi.Mac(d_cmp_pr=0)}, "params.te.d_cmp_pr is 0; it must be between 1e-9 and 1e9"),
    ({"te": ibi.Mac(t_sog=-0.5)}, "params.te.t_sog is -0.5; it must be between 0 and 1"),
    ({"te": ibi.Mac(max_cliques=2 * 10**9)}, "params.te.max_cliques is 2000000000; it must be at most"),
    ({"te": ibi.Mac(max_steps=0)}, "params.te.max_steps is 0; it must be at least 1"),
    ({"hv": ibi.Evidence(t_score=1.1)}, "params.hv.t_score is 1.1; it must be between 0 and 1"),
    ({"hv": ibi.Evidence(t_score=-0.1)}, "params.hv.t_score is -0.1; it must be between 0 and 1"),
    ({"hv": ibi.Evidence(t_score=NAN)}, f"params.hv.t_score is nan; {FLOAT}"),
    ({"hv": ibi.Evidence(exclusive=None)}, f"params.hv.exclusive is None; {BOOL}"),
    ({"hv": ibi.Overlap(t_overlap=1.1)}, "params.hv.t_overlap is 1.1; it must be between 0 and 1"),
    ({"hv": ibi.Overlap(t_overlap=NAN)}, f"params.hv.t_overlap is nan; {FLOAT}"),
    ({"hv": ibi.InlierCount(t_inliers=0)}, "params.hv.t_inliers is 0; it must be at least 1"),
]


@pytest.mark.parametrize(("given", "start"), REFUSED, ids=[case[1][:40] for case in REFUSED])
def test_what_is_out_of_range_is_refused_in_one_short_line(given, start):
    for make in (ibi.Params, PLAIN.replace):
        with pytest.raises(ibi.ParamsError) as caught:
            make(**given)
        message = str(caught.value)
        assert message.startswith(start)
        assert "\n" not in message
        assert len(message) < 200


DATA = [
    ({"t_z": 1}, "`t_z`"),
    ({"seed": 1, "Seed": 2}, "`Seed`"),
    ({1: 2}, "`1`"),
    ({"odd": object()}, "`odd`"),
    ({"odd": {"x": NAN}}, "`odd`"),
    ({"scs": {"variant": "gtm", "n_gmt": 1}}, "`n_gmt`"),
    ({"te": {"variant": "gsac", "n_ransac": 1}}, "`n_ransac`"),
    ({"te": {"n_gsac": 5}}, "`n_gsac`"),
    ({"base": "singel_view"}, "params.base is 'singel_view'; it must be one of 'default', 'paper_synthetic'"),
    ({"base": ["default"]}, "params.base is ['default']; it must be one of 'default', "),
    ({"te": None}, "params.te is None; it must be one of 'gsac', "),
    ({"te": {"variant": "g"}}, "params.te is 'g'; it must be one of 'gsac', "),
    ({"te": {"variant": ["gsac"]}}, "params.te is ['gsac']; it must be one of 'gsac', "),
    ({"te": {"variant": np.array([1, 2])}}, "params.te is array([1, 2]); it must be one of 'gsac', "),
    ({"te": {"variant": "gsac", "n_gsac": "5"}}, f"params.te.n_gsac is '5'; {INT}"),
    ({"seed": {}}, f"params.seed is {{}}; {INT}"),
    ({"t_he_pr": [3]}, f"params.t_he_pr is [3]; {FLOAT}"),
    ({"t_s": 2}, "params.t_s is 2; it must be at least 3"),
]


@pytest.mark.parametrize(("data", "part"), DATA, ids=[case[1][:40] for case in DATA])
def test_a_dict_is_refused_by_the_name_of_what_is_wrong(data, part):
    with pytest.raises(ibi.ParamsError) as caught:
        ibi.Params.from_dict(data)
    assert part in str(caught.value)
    assert "\n" not in str(caught.value)


TOML = [
    ("t_z = 1", "`t_z`"),
    ("t_s = 2", "params.t_s is 2; it must be at least 3"),
    ("t_he_pr = nan", "params.t_he_pr is NaN; it must be between"),
    ("\nseed = -1", "line 2"),
    ('\nmax_rejections = "nope"', "line 2"),
    ("max_rejections = 1.5", 'a number or "none"'),
    ('min_normal_cos = "1"', 'a number or "none"'),
    ('t_s = "none"', "line 1"),
    ("seed == 1", "line 1"),
    ('[ce]\nvariant = "of"', "`of`"),
    ('\nce = "of"', "line 2"),
    ('\nce = "of"', "`of`"),
    ("ce = 3", "line 1"),
    ('ce = "off"\n\nseed = -1', "line 3"),
    ('[scs]\nvariant = "gtm"\nn_gmt = 1', "`n_gmt`"),
]


@pytest.mark.parametrize(("text", "part"), TOML, ids=[case[1][:40] for case in TOML])
def test_toml_is_refused_with_the_place(text, part):
    with pytest.raises(ibi.ParamsError) as caught:
        ibi.Params.from_toml(text)
    assert part in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["bad.toml", "bad.json"])
@pytest.mark.parametrize("text", ['{"t_z": 1}', "t_z = 1", "?", "\xff"])
def test_a_bad_file_is_named(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text, encoding="latin-1")
    with pytest.raises(ibi.ParamsError, match=r"bad\.(toml|json): ") as caught:
        ibi.Params.load(path)
    assert "\n" not in str(caught.value)


def test_a_file_says_its_format_by_its_name(tmp_path):
    for action in (PLAIN.save, ibi.Params.load):
        with pytest.raises(
            ibi.ParamsError, match=r"params\.yaml: a parameter file must end in \.toml or \.json"
        ):
            action(tmp_path / "params.yaml")
    with pytest.raises(FileNotFoundError):
        ibi.Params.load(tmp_path / "missing.toml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "must be a JSON object, not []"),
        ("3", "must be a JSON object, not 3"),
        ("null", "must be a JSON object, not None"),
        ("NaN", "must be a JSON object, not nan"),
        ("", "is no JSON: "),
        ('{"t_s": 4', "is no JSON: "),
        ("[" * 100_000, "it is nested too deeply"),
        ('{"a":' * 100_000, "it is nested too deeply"),
        ('{"scs": null}', "params.scs is None; it must be one of 'gtm'"),
    ],
)
def test_json_that_holds_no_parameters_is_refused_with_its_name(tmp_path, text, message):
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(ibi.ParamsError) as caught:
        ibi.Params.load(path)
    assert str(caught.value).startswith(f"{path}: {message}")
    assert "\n" not in str(caught.value)


def test_a_file_may_begin_with_a_mark_of_its_encoding(tmp_path):
    for name, text in (("p.json", '{"t_s": 6}'), ("p.toml", "t_s = 6")):
        (tmp_path / name).write_text(text, encoding="utf-8-sig")
        assert ibi.Params.load(tmp_path / name) == ibi.Params(t_s=6)


@pytest.mark.parametrize("data", [None, 3, [("t_s", 5)], "t_s"])
def test_a_dict_must_be_one(data):
    with pytest.raises(TypeError, match="params must be a mapping, not"):
        ibi.Params.from_dict(data)


def test_unknown_names_are_named():
    for make in (ibi.Params, *(variant for _, variant in EACH_VARIANT)):
        with pytest.raises(TypeError, match="t_z"):
            make(t_z=1)
        with pytest.raises(TypeError, match="positional"):  # a bare number says nothing
            make(1)


def test_parameter_errors_cross_processes():
    with pytest.raises(ibi.ParamsError) as caught:
        ibi.Params(t_s=1)
    twin = pickle.loads(pickle.dumps(caught.value))
    assert (type(twin), str(twin)) == (ibi.ParamsError, str(caught.value))
