"""Parameters: frozen dataclasses, one block per stage.

Every length ends in ``_pr`` and is a multiple of the resolution ``pr``, the mean of the two clouds' mean
nearest-neighbour distances, so nothing depends on the unit of the data. Defaults and ranges are the Rust
core's; a value out of range raises :class:`~ibi_rs.ParamsError` where the object is made.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args, get_type_hints

import numpy as np

from ibi_rs import _core, stages
from ibi_rs._files import written
from ibi_rs.variants import (
    Ce,
    Evidence,
    Hv,
    Irls,
    LocalGtm,
    Scs,
    Te,
    Voting,
)

_P = TypeVar("_P", bound="Params")


Refine = Literal["none", "icp", "icp_turns"]
Removal = Literal["dense", "inliers"]
Preset = Literal["default", "paper_synthetic", "paper_real", "single_view", "many_views"]
ScsWord = Literal["gtm", "local_gtm", "nnsr", "hough3d"]
CeWord = Literal["voting", "off"]
TeWord = Literal["gsac", "irls", "ransac", "sac_cot", "mac"]
HvWord = Literal["evidence", "overlap", "inlier_count", "none"]

_STAGES: dict[str, tuple[type[Any], ...]] = {
    "scs": get_args(Scs),
    "ce": get_args(Ce),
    "te": get_args(Te),
    "hv": get_args(Hv),
}


@dataclass(frozen=True, kw_only=True)
class Params:
    """How a registration runs.

    The default is not of the paper: all correspondences play, one neighbourhood of a second-order
    compatibility graph at a time; hypotheses are polished on the clouds, judged by how unlikely their support
    is by chance, and compete for the scene before and after they are accepted. It is for scenes that show
    their objects whole or nearly so; normals help where both clouds have them.

    A stage may be given by its word, ``Params(ce="off")``, which takes that variant's defaults.

    Parameters
    ----------
    seed
        Key of all random streams: the same seed gives the same bits, for any number of threads; >= 0.
    resolution
        pr in data units; None estimates it from the clouds.
    delta_r_pr
        delta_r of Eq. 5: how fast payoff and votes fall with the rigidity, in pr; > 0.
    t_he_pr
        t_he of Eq. 8: largest residual of an inlier, in pr; > 0.
    d_op_pr
        d_op: largest distance of overlapping points, in pr; > 0.
    min_normal_cos
        Least cosine between the normals of an inlier's two points, and of overlapping points, -1 to 1. None
        leaves normals out of both.
    oriented_normals
        Whether the normals are oriented: outwards on the source, towards the camera on the target; then
        points that cannot be seen from a viewpoint count in no overlap. If not, they are compared up to sign.
    t_s
        t_s: a run ends when fewer seeds than this are found; at least 3.
    scs, ce, te, hv
        The four stages: seed correspondence selection, correspondence enhancement, transformation estimation,
        hypothesis validation. Each is a variant, or a callable of your own: :mod:`ibi_rs.stages`. Parameters
        with a callable are equal, hash and pickle as the callable does, and cannot be written to a file.
    refine
        How a hypothesis is polished on the clouds: ``"none"``, or ``"icp"``, iterative closest points,
        point-to-plane where normals count. Of an accepted one the better of before and after stays, and at
        least ``t_s`` correspondences still agree with it. ``"icp_turns"``: in a scene seen from one side,
        what is about to become an instance is also turned by right angles about the model's principal axes,
        and the best of the 24 poses taken.
    n_contest
        A contest lasts this many rounds: at its end the hypotheses that passed validation become instances,
        best value first. 1: each at once, as it is found. At least 1.
    joint_check
        Whether at the end all accepted poses compete for the target at once: each point of it belongs to the
        nearest pose, and poses that fail validation on what is their own are dropped.
    removal
        Which correspondences a round removes; ``"dense"``: those that the enhancement ranked; ``"inliers"``:
        those within 2 ``t_he`` of an accepted instance and those whose target point it explains, while the
        seeds of a round, accepted or not, may not lead again.
    max_rejections, max_rounds, max_instances
        A run ends after so many rounds without a new instance, rounds, or instances; None: no limit.
    timeout_s
        A run ends after so many seconds and keeps what it has; None: no limit. What was found by then is
        still checked and ranked as far as a bounded amount of work goes, enough for some hundred poses; a
        pose for which it does not suffice is left out, so that each score is true. All of it counts:
        preparation, rounds and the checks at the end. A run that is ended while it is prepared has no rounds
        and ``resolution`` 0.

    Raises
    ------
    ParamsError
        A value is out of its range; the message names it and says what is allowed.

    References
    ----------
    Cao et al., "Instance by Instance: An Iterative Framework for Multi-instance 3D Registration".

    Examples
    --------
    >>> import ibi_rs as ibi
    >>> ibi.Params(hv=ibi.Overlap(t_overlap=0.35), t_he_pr=2).hv
    Overlap(t_overlap=0.35, exclusive=False)
    """

    seed: int = 0
    resolution: float | None = None
    delta_r_pr: float = 1.0
    t_he_pr: float = 1.5
    d_op_pr: float = 1.5
    min_normal_cos: float | None = 0.3
    oriented_normals: bool = False
    t_s: int = 4
    scs: Scs | stages.SelectSeeds = LocalGtm()
    ce: Ce | stages.Enhance = Voting()
    te: Te | stages.EstimatePose = Irls()
    hv: Hv | stages.Validate = Evidence()
    refine: Refine = "icp"
    n_contest: int = 60
    joint_check: bool = True
    removal: Removal = "inliers"
    max_rejections: int | None = 60
    max_rounds: int | None = None
    max_instances: int | None = None
    timeout_s: float | None = None

    if TYPE_CHECKING:  # a stage goes in as a word, too, and comes out as a variant: no field has two types

        def __init__(
            self,
            *,
            seed: int = 0,
            resolution: float | None = None,
            delta_r_pr: float = 1.0,
            t_he_pr: float = 1.5,
            d_op_pr: float = 1.5,
            min_normal_cos: float | None = 0.3,
            oriented_normals: bool = False,
            t_s: int = 4,
            scs: Scs | ScsWord | stages.SelectSeeds = LocalGtm(),
            ce: Ce | CeWord | stages.Enhance = Voting(),
            te: Te | TeWord | stages.EstimatePose = Irls(),
            hv: Hv | HvWord | stages.Validate = Evidence(),
            refine: Refine = "icp",
            n_contest: int = 60,
            joint_check: bool = True,
            removal: Removal = "inliers",
            max_rejections: int | None = 60,
            max_rounds: int | None = None,
            max_instances: int | None = None,
            timeout_s: float | None = None,
        ) -> None: ...

    def __post_init__(self) -> None:
        """Turn words into stages and let the core check everything."""
        for name, variants in _STAGES.items():
            stage = getattr(self, name)
            if isinstance(stage, str):
                object.__setattr__(self, name, _variant(name, stage)())
            elif not isinstance(stage, variants) and not _is_own(stage):
                allowed = ", ".join([*(f"{variant.__name__}()" for variant in variants), "a callable"])
                raise _core.ParamsError(f"params.{name} is {_shown(stage)}; it must be one of {allowed}")
        # numpy scalars become plain numbers here, so that equality, repr and pickles are those of plain data.
        complete = json.loads(_core.check_params(_dumps(self._built_in())))
        for name, value in _build(complete).items():
            if name in self._own():
                continue
            object.__setattr__(self, name, value)

    @classmethod
    def paper_synthetic(cls: type[_P]) -> _P:
        """Return the paper's setting for its synthetic data."""
        return cls.from_dict(json.loads(_core.preset("paper_synthetic")))

    @classmethod
    def paper_real(cls: type[_P]) -> _P:
        """Return the paper's setting for its real data."""
        return cls.from_dict(json.loads(_core.preset("paper_real")))

    @classmethod
    def single_view(cls: type[_P]) -> _P:
        """Return the setting for a scene seen by one depth camera.

        Give the normals of both clouds, oriented, and the viewpoint. Not of the paper: all correspondences
        play, one neighbourhood at a time; a hypothesis is polished on the clouds before it is judged, by the
        source points that the camera can see and the scene points that no other instance explains; hypotheses
        compete before one becomes an instance, and that one is tried the other ways round.
        """
        return cls.from_dict(json.loads(_core.preset("single_view")))

    @classmethod
    def many_views(cls: type[_P]) -> _P:
        """Return what fits a scene seen from many places: by a camera that went about, or from all sides.

        Give the normals of both clouds, oriented, and where the camera stood, if that is known.
        :meth:`single_view`, with more patience: large scenes hold much that looks like a part.
        """
        return cls.from_dict(json.loads(_core.preset("many_views")))

    @classmethod
    def preset(cls: type[_P], name: Preset) -> _P:
        """Return the preset of that name: ``default``, ``single_view`` and so on; ParamsError for others."""
        return cls.from_dict(_preset(name))

    def replace(self: _P, **changes: Any) -> _P:
        """Return a copy with ``changes``; unknown names raise TypeError.

        Of a stage that is given as a dict, or by ``"stage.parameter"``, all else stays as it is; but another
        ``variant`` brings its own defaults.

        Examples
        --------
        >>> import ibi_rs as ibi
        >>> params = ibi.Params.single_view()
        >>> params.replace(hv={"t_score": 0.97}) == params.replace(**{"hv.t_score": 0.97})
        True
        >>> params.replace(hv={"t_score": 0.97}).hv.t_sure == params.hv.t_sure
        True
        """
        blocks: dict[str, dict[str, Any]] = {}
        for name in [name for name, value in changes.items() if "." in name or isinstance(value, Mapping)]:
            stage, _, parameter = name.partition(".")
            if stage not in _STAGES:
                continue  # of which it is told as of other unknown names, or wrong values
            value = changes.pop(name)
            blocks.setdefault(stage, {}).update({parameter: value} if parameter else value)
        for stage, block in blocks.items():
            if stage in changes:  # te="mac" beside "te.t_cmp"
                block = {"variant": getattr(changes[stage], "variant", changes[stage])} | block
                if dataclasses.is_dataclass(changes[stage]):
                    block = dataclasses.asdict(changes[stage]) | block
            held = None if _is_own(getattr(self, stage)) else self._built_in()[stage]
            data = {stage: _laid(stage, held, block)}
            changes[stage] = _build(json.loads(_core.check_params(_dumps(data))))[stage]
        return dataclasses.replace(self, **changes)

    def to_dict(self) -> dict[str, Any]:
        """Return plain nested data; each stage carries its word under ``variant``.

        Raises ParamsError, as do :meth:`to_toml` and :meth:`save`, if a stage is a callable.
        """
        for name, own in self._own().items():
            raise _core.ParamsError(f"params.{name} is {_shown(own)}; a callable has no text form")
        return self._built_in()

    @classmethod
    def from_dict(cls: type[_P], data: Mapping[str, Any], *, base: Params | None = None) -> _P:
        """Build from nested data; an unknown key raises ParamsError.

        What is missing is that of the preset that ``"base"`` names (``{"base": "single_view"}``), else that
        of the argument ``base``, else the default. A stage is a block, or a word alone; a block that names
        another ``variant`` than the base has brings its own defaults.
        """
        if not isinstance(data, Mapping):
            raise TypeError(f"params must be a mapping, not {type(data).__name__}")
        blocks = _on_base(data, base)
        return cls(**_build(json.loads(_core.check_params(_dumps(blocks)))))

    def to_toml(self) -> str:
        """Return the text of a parameter file."""
        return _core.params_to_toml(_dumps(self.to_dict()))

    @classmethod
    def from_toml(cls: type[_P], text: str, *, base: Params | None = None) -> _P:
        """Build from the text of a parameter file, as :meth:`from_dict`."""
        data = json.loads(_core.toml_to_json(text))
        if base is None and "base" not in data and all(_is_whole(data.get(stage, "")) for stage in _STAGES):
            return cls(**_build(json.loads(_core.params_from_toml(text))))  # errors of which name the line
        return cls.from_dict(_with_nulls(data), base=base)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a parameter file; ``.toml`` or ``.json``."""
        path = Path(path)
        text = self.to_toml() if _is_toml(path) else json.dumps(self.to_dict(), indent=2)
        with written(path) as part:
            part.write_text(text, encoding="utf-8")

    @classmethod
    def load(cls: type[_P], path: str | os.PathLike[str], *, base: Params | None = None) -> _P:
        """Read a parameter file; ``.toml`` or ``.json``. ParamsError names it and what is wrong in it.

        What it leaves out is taken as by :meth:`from_dict`.
        """
        path = Path(path)
        is_toml = _is_toml(path)
        try:
            text = path.read_text(encoding="utf-8-sig")
            if is_toml:
                return cls.from_toml(text, base=base)
            data = json.loads(text)
            if not isinstance(data, dict):
                raise _core.ParamsError(f"must be a JSON object, not {_shown(data)}")
            return cls.from_dict(data, base=base)
        except RecursionError:
            raise _core.ParamsError(f"{path}: it is nested too deeply") from None
        except ValueError as error:  # of the text, its encoding or the parameters
            kind = "is no JSON: " if isinstance(error, json.JSONDecodeError) else ""
            raise _core.ParamsError(f"{path}: {kind}{error}") from None

    def _own(self) -> dict[str, Callable[..., Any]]:
        """Return the stages that are callables."""
        return {name: getattr(self, name) for name in _STAGES if _is_own(getattr(self, name))}

    def _built_in(self) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in _STAGES:
                if _is_own(value):
                    continue
                value = {"variant": value.variant, **dataclasses.asdict(value)}
            out[field.name] = value
        return out

    @cached_property
    def _json(self) -> str:
        """All but the callables, in the place of which the core has its defaults."""
        return _dumps(self._built_in())


@cache
def _default() -> Params:
    """Make the default parameters once: to check them takes as long as a small scene's rounds."""
    return Params()


def _limited(params: Params | None, max_instances: int | None, timeout_s: float | None) -> Params:
    """Return the parameters of a run."""
    params = _default() if params is None else params
    if not isinstance(params, Params):
        raise TypeError(f"params must be ibi_rs.Params, not {type(params).__name__}")
    overrides = {"max_instances": max_instances, "timeout_s": timeout_s}
    overrides = {name: value for name, value in overrides.items() if value is not None}
    return params.replace(**overrides) if overrides else params


def _is_own(stage: Any) -> bool:
    """Whether it can be called for a stage; a class is more likely a variant without its brackets."""
    return callable(stage) and not isinstance(stage, type)


def _preset(name: Any) -> dict[str, Any]:
    allowed = get_args(Preset)
    if not isinstance(name, str) or name not in allowed:
        raise _core.ParamsError(
            f"params.base is {_shown(name)}; it must be one of {', '.join(map(repr, allowed))}"
        )
    preset: dict[str, Any] = json.loads(_core.preset(name))
    return preset


def _on_base(data: Mapping[str, Any], base: Params | None) -> dict[str, Any]:
    """Lay data over the preset that they name, or over the base; their stages over its stages."""
    own = dict(data)
    held = {} if base is None else base.to_dict()
    if "base" in own:
        held = _preset(own.pop("base"))
    stages_of_default = json.loads(_core.preset("default"))
    for stage in _STAGES.keys() & own.keys():
        own[stage] = _laid(stage, held.get(stage, stages_of_default[stage]), own[stage])
    return {**held, **own}


def _laid(stage: str, held: Mapping[str, Any] | None, value: Any) -> dict[str, Any]:
    """Lay a stage, a block or a word, over the one that is held; None: a callable."""
    block = dict(value) if isinstance(value, Mapping) else {"variant": value}
    if held is None and "variant" not in block:
        raise _core.ParamsError(f"params.{stage} names no variant; add 'variant' to its block")
    if held is not None:
        block.setdefault("variant", held["variant"])
    variant = _variant(stage, block["variant"]).variant
    if held is not None and variant == held["variant"] and isinstance(value, Mapping):
        return {**held, **block}
    return block


def _is_whole(block: Any) -> bool:
    """Whether a stage names its variant, or is a word."""
    return not isinstance(block, Mapping) or "variant" in block


def _with_nulls(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Copy what TOML holds, which says "none" for None."""
    out = {}
    for key, value in data.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            value = _with_nulls(value, f"{name}.")
        elif value == "none" and type(None) in get_args(_HINTS.get(name)):
            value = None
        out[key] = value
    return out


def _variant(stage: str, word: Any) -> type[Any]:
    for variant in _STAGES[stage]:
        if isinstance(word, str) and variant.variant == word:  # an array is equal to nothing and everything
            return variant
    allowed = ", ".join(repr(variant.variant) for variant in _STAGES[stage])
    raise _core.ParamsError(f"params.{stage} is {_shown(word)}; it must be one of {allowed}")


def _build(data: Mapping[str, Any]) -> dict[str, Any]:
    """Turn complete, checked data into constructor arguments."""
    arguments = dict(data)
    for stage in _STAGES:
        block = dict(arguments[stage])
        arguments[stage] = _variant(stage, block.pop("variant"))(**block)
    return arguments


def _dumps(data: Mapping[str, Any]) -> str:
    return json.dumps(_plain(data))


def _plain(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Copy nested data, numpy scalars as plain numbers; refuse what has a wrong type.

    The core would refuse it too, but where its JSON reader stands it no longer knows the parameter's name.
    Ranges are left to the core, and so are unknown keys.
    """
    out: dict[str, Any] = {}
    for key, value in data.items():
        name = f"{prefix}{key}"
        if isinstance(value, (np.generic, np.ndarray)) and value.ndim == 0:
            value = value.item()
        if name in _HINTS:
            if allowed := _refusal(name, value):
                raise _core.ParamsError(f"params.{name} is {_shown(value)}; it must be {allowed}")
        elif isinstance(value, Mapping):
            value = _plain(value, f"{name}.")
        elif name.rpartition(".")[2] != "variant":
            value = None  # an unknown key, which the core refuses by its name
        out[str(key)] = value
    return out


def _shown(value: Any) -> str:
    """Show a value in part of a line, whatever it is."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:60]}..."


_HINTS: dict[str, Any] = {
    name: hint for name, hint in get_type_hints(Params).items() if name not in _STAGES
} | {
    f"{stage}.{name}": hint
    for stage, variants in _STAGES.items()
    for variant in variants
    for name, hint in get_type_hints(variant).items()
    if name != "variant"
}
"""The type of each parameter by its path."""


def _refusal(name: str, value: Any) -> str | None:
    """Say what the value should be; None if its type is right."""
    kinds = get_args(_HINTS[name]) or (_HINTS[name],)
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if value is None and type(None) in kinds:
        return None
    if bool in kinds:
        return None if isinstance(value, bool) else "True or False"
    if int in kinds:
        most = 2**64 - 1 if name == "seed" else 2**32 - 1
        fine = is_number and isinstance(value, int) and 0 <= value <= most
        return None if fine else f"an integer from 0 to {most}"
    if float in kinds:  # JSON knows neither NaN nor infinity
        return None if is_number and -1e300 < value < 1e300 else "a finite number"
    return None if isinstance(value, str) and value in kinds else "one of " + ", ".join(map(repr, kinds))


def _is_toml(path: Path) -> bool:
    if path.suffix not in {".toml", ".json"}:
        raise _core.ParamsError(f"{path}: a parameter file must end in .toml or .json")
    return path.suffix == ".toml"
