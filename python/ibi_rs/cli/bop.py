"""`ibi bop`: all images of a data set in the folders of BOP."""

from __future__ import annotations

import functools
import hashlib
import json
import multiprocessing
import pickle
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Annotated, Any

import numpy as np
import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

import ibi_rs as ibi
from ibi_rs import datasets
from ibi_rs._batch import _Batch, _cores
from ibi_rs._files import try_writing
from ibi_rs.datasets import BopImage

from .outputs import sha256
from .search import MaxInstances, ParamsFile, Preset, TimeoutS, Voxel, changes_of
from .terminal import MAX_THREADS, Verbose, command, err, misused, out, say

_WINDOW = 4
"""Images under way for each worker."""


@command()
def bop(
    dataset: Annotated[Path, typer.Argument(help="Folder of the data set, with `models` and `test` in it.")],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="All poses as BOP's CSV; BOP wants METHOD_DATASET-SPLIT.csv."),
    ] = None,
    score: Annotated[
        Path | None, typer.Option(help="Score this CSV, of any method, instead of making one.")
    ] = None,
    split: Annotated[str, typer.Option(help="Folder of the images: test, val, test_primesense ...")] = "test",
    camera: Annotated[
        list[str] | None,
        typer.Option(help="Of sets with several: its name. Given again, one scan is made of all."),
    ] = None,
    targets: Annotated[
        str | None,
        typer.Option(
            help="File in DATASET that lists the images, or 'all'. Default: BOP's, in a test split."
        ),
    ] = None,
    objects: Annotated[str | None, typer.Option(help="Only these, as 1,5,8.")] = None,
    voxel: Voxel = None,
    preset: Preset = None,
    params: ParamsFile = None,
    max_instances: MaxInstances = None,
    timeout_s: TimeoutS = None,
    jobs: Annotated[
        int | None,
        typer.Option(min=1, max=MAX_THREADS, help="Processes, an image each. Default: one for each core."),
    ] = None,
    threads: Annotated[int, typer.Option(min=1, max=MAX_THREADS, help="Of each image.")] = 1,
    cluster: Annotated[
        str | None,
        typer.Option(help="Run there: 'ray', ray://HOST:PORT, or tcp://HOST:PORT of a scheduler of Dask."),
    ] = None,
    verbose: Verbose = 0,
) -> None:
    """Find all objects in all images of a data set of BOP, and score what was found.

    A whole data set:       ibi bop bop/ycbv -o ibi_ycbv-test.csv

    What another found:     ibi bop bop/ycbv --score other_ycbv-test.csv

    An industrial set:      ibi bop bop/ipd --split val --camera photoneo -o
    ibi_ipd-val.csv

    The objects that the targets name are looked for in an image, or all of the
    data set where they name none. An image has one time: of all its objects,
    reading it included, without preparing the models. t is in millimetres.

    What is done is written to OUTPUT.journal, image by image. After Ctrl-C the
    same command goes on from there; with other models, parameters or options it
    begins anew, and says so. The journal is removed at the end.

    An image that fails costs one line; the CSV lacks it, the journal stays, and
    the same command tries it again.

    Exit code: 0; 1 if an image failed or the input is at fault; 2 if the
    command line is; 130 after Ctrl-C.
    """
    if (output is None) == (score is None):
        misused("give -o to make a CSV, or --score to score one")
    changes = changes_of(preset, params, None)
    chosen = changes.on(ibi.Params.single_view()) if changes.is_any else None
    cameras: Any = camera[0] if camera and len(camera) == 1 else camera or None
    scenes = datasets.Bop(dataset, split=split, camera=cameras, targets=targets, objects=_numbers(objects))
    if score is not None:
        _show(datasets.read_bop_results(score), scenes)
        return
    assert output is not None
    try_writing(output)
    work = _Work(pickle.dumps(scenes), chosen, voxel, threads, max_instances, timeout_s)
    journal = _Journal(Path(f"{output}.journal"), _depends_on(scenes, work))
    todo = [i for i, ids in enumerate(scenes.ids) if ids not in journal.images]
    if journal.images:
        say(f"{len(journal.images)} of {len(scenes)} images are done already")
    failed = 0

    def keep(number: int, found: BopImage | ibi.JobError) -> None:
        nonlocal failed
        if isinstance(found, ibi.JobError):
            failed += 1
            scene_id, im_id = scenes.ids[todo[number]]
            say(f"{scene_id:06d}/{im_id:06d}: {found.reason}")
        else:
            journal.add(found)

    with journal.opened(), _executor(cluster, jobs or _cores(), len(todo)) as (make, is_ours, workers):
        _run_all(work, todo, keep, make, is_ours, _WINDOW * workers)
    images = list(journal.images.values())
    datasets.write_bop_results(output, images)
    if not failed:
        journal.path.unlink(missing_ok=True)
    _show(images, scenes)
    if failed:
        say(f"{failed} of {len(scenes)} images failed; the same command tries them again")
        raise typer.Exit(1)


def _numbers(given: str | None) -> list[int] | None:
    if given is None:
        return None
    words = given.replace(",", " ").split()
    if not words or not all(word.isdecimal() for word in words):
        misused(f"--objects {given}: must be numbers, as 1,5,8")
    return [int(word) for word in words]


# In a worker ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Work:
    """What is done with an image, by its number in the data set."""

    scenes: bytes
    params: ibi.Params | None
    voxel: float | None
    num_threads: int
    max_instances: int | None
    timeout_s: float | None

    def __call__(self, number: int, _attempt: int) -> BopImage:
        scenes = _loaded(self.scenes)
        scene = scenes[number]
        names = tuple(int(part.kind.name) for part in scene.parts)
        models = _models(self.scenes, names, self.voxel)
        start = time.perf_counter()
        found = models.detect(
            **scene.inputs,
            params=self.params,
            num_threads=self.num_threads,
            max_instances=self.max_instances,
            timeout_s=self.timeout_s,
        )
        seconds = time.perf_counter() - start
        ids = np.array([names[pose.model] for pose in found], np.int64)
        scores = np.array([pose.score for pose in found], np.float64)
        scene_id, im_id = scene.ids
        return BopImage(scene_id, im_id, ids, scores, np.asarray(found), seconds)


@functools.lru_cache(maxsize=2)
def _loaded(scenes: bytes) -> datasets.Bop:
    held = pickle.loads(scenes)
    assert isinstance(held, datasets.Bop)
    return held


@functools.lru_cache(maxsize=256)
def _model(scenes: bytes, obj_id: int, voxel: float | None) -> ibi.Model:
    return _loaded(scenes).kind(obj_id).model(voxel=voxel)


@functools.lru_cache(maxsize=32)
def _models(scenes: bytes, obj_ids: tuple[int, ...], voxel: float | None) -> ibi.Models:
    return ibi.Models({str(obj_id): _model(scenes, obj_id, voxel) for obj_id in obj_ids})


# Running ----------------------------------------------------------------------------------------------------


@contextmanager
def _executor(
    cluster: str | None, jobs: int, num_images: int
) -> Iterator[tuple[Callable[[], Executor], bool, int]]:
    """Tell what makes an executor, whether it is ended with the batch, and how many work in it."""
    if cluster is None:
        workers = max(1, min(jobs, num_images))
        if workers == 1:
            yield functools.partial(ThreadPoolExecutor, 1), True, 1
            return
        # A fork would have the locks of threads that it has not.
        context = multiprocessing.get_context("spawn")
        yield functools.partial(ProcessPoolExecutor, workers, context), True, workers
    elif cluster == "ray" or cluster.startswith("ray://"):
        executor = ibi.RayExecutor()
        ray = executor._ray
        is_ours = not ray.is_initialized()
        if is_ours:
            ray.init(address=None if cluster == "ray" else cluster, log_to_driver=False)
        try:
            yield (lambda: executor), False, int(ray.cluster_resources().get("CPU", 1))
        finally:
            if is_ours:
                ray.shutdown()
    else:
        try:
            from distributed import Client
        except ImportError as error:
            raise ImportError(f"Dask is needed: pip install 'ibi_rs[dask]' ({error})") from error
        with Client(cluster) as client:
            held = client.get_executor(pure=False)
            yield (lambda: held), False, max(1, len(client.scheduler_info()["workers"]))


def _run_all(
    work: _Work,
    todo: list[int],
    keep: Callable[[int, BopImage | ibi.JobError], None],
    make: Callable[[], Executor],
    is_ours: bool,
    window: int,
) -> None:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    options: dict[str, Any] = {"transient": True, "redirect_stdout": False, "disable": not err.is_terminal}
    with Progress(*columns, console=err, **options) as progress:
        bar = progress.add_task("detecting", total=len(todo))

        def ended(number: int, found: BopImage | ibi.JobError) -> None:
            keep(number, found)
            progress.advance(bar)

        for _ in _Batch(work, todo, make, is_ours=is_ours, window=window, callback=ended):
            pass


# What is done already ---------------------------------------------------------------------------------------


def _depends_on(scenes: datasets.Bop, work: _Work) -> dict[str, Any]:
    """Return what results depend on, but for the images themselves."""
    digest = hashlib.sha256()
    for obj_id in scenes.objects:
        digest.update(f"{obj_id} {sha256(scenes.kind(obj_id).path)}\n".encode())
    digest.update(sha256(scenes.models / "models_info.json").encode())
    return {
        "ibi_rs": ibi.__version__,
        "dataset": repr(scenes),
        "models_sha256": digest.hexdigest(),
        "params": None if work.params is None else work.params.to_dict(),
        "voxel": work.voxel,
        "max_instances": work.max_instances,
        "timeout_s": work.timeout_s,
    }


class _Journal:
    """The images that are done, a line each, behind a line that says of what and how."""

    def __init__(self, path: Path, head: dict[str, Any]) -> None:
        self.path, self._head = path, head
        self.images: dict[tuple[int, int], BopImage] = {}
        self._file: IO[str]
        if not path.is_file():
            return
        lines = path.read_text(encoding="utf-8").splitlines()
        before = _line(lines[0]) if lines else None
        if before != json.loads(json.dumps(head)):
            other = [key for key in head if not isinstance(before, dict) or before.get(key) != head[key]]
            say(f"{path.name}: made with other {', '.join(other)}; all images are done again")
            return
        for held in filter(None, map(_line, lines[1:])):  # the last may be cut
            ids, scores, poses = (held[name] for name in ("obj_ids", "scores", "poses"))
            image = BopImage(
                held["scene_id"],
                held["im_id"],
                np.array(ids, np.int64),
                np.array(scores, np.float64),
                np.array(poses, np.float64).reshape(-1, 4, 4),
                held["seconds"],
            )
            self.images[image.scene_id, image.im_id] = image

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Write it anew, without what was cut; then image by image."""
        with self.path.open("w", encoding="utf-8") as file:
            self._file = file
            self._write(self._head)
            for image in self.images.values():
                self._write(_as_dict(image))
            yield

    def add(self, image: BopImage) -> None:
        self.images[image.scene_id, image.im_id] = image
        self._write(_as_dict(image))

    def _write(self, held: dict[str, Any]) -> None:
        self._file.write(json.dumps(held) + "\n")
        self._file.flush()


def _line(text: str) -> Any:
    with suppress(ValueError):
        return json.loads(text)
    return None


def _as_dict(image: BopImage) -> dict[str, Any]:
    arrays = {name: getattr(image, name).tolist() for name in ("obj_ids", "scores", "poses")}
    return {"scene_id": image.scene_id, "im_id": image.im_id, "seconds": image.seconds, **arrays}


# Printing ---------------------------------------------------------------------------------------------------


def _show(images: list[BopImage], scenes: datasets.Bop) -> None:
    told = sum(len(image.poses) for image in images)
    lines = [f"images     {len(scenes)}", f"poses      {told}"]
    if all(scenes[i].has_truth for i in range(len(scenes))):
        held = datasets.score_bop(images, scenes)
        lines += [
            f"targets    {held.num_targets}",
            f"recall     {held.ar_mssd:.3f}  (BOP's average recall, MSSD below 0.05 .. 0.5 diameters)",
            f"AP in mm   {held.ap_mm:.3f}  (BOP-Industrial's, MSSD below 2 .. 20 mm)",
            f"AP         {held.ap:.3f}  (MSSD below 0.05 .. 0.5 diameters)",
            f"MHF1       {held.mhf1:.3f}  (one to one, ADD-S below 0.1 diameters)",
        ]
    else:
        lines.append("no scene_gt.json: not scored")
    seconds = [image.seconds for image in images if image.seconds >= 0]
    if seconds:
        lines.append(f"seconds    {np.mean(seconds):.3f}  an image, in the mean")
    for line in lines:
        out.print(line, highlight=False, markup=False, soft_wrap=True)
