"""`register_batch` on a local cluster of Dask and of Ray, for real: `make test-clusters` has these run."""

import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import ibi_rs as ibi
import numpy as np
import pytest
import tiny_sets
from test_batch import EXPECTED, JOBS, MODEL, SCENES, content, values
from test_cli import run
from test_detector import batch
from test_process import LIMIT_S
from tiny_sets import BOX

NO_CLUSTERS = "large, so not in the group of the tests: `make test-clusters` installs it and has these run"


@dataclass(frozen=True, eq=False, repr=False)
class Deadly(ibi.Job):
    """Kills its worker until the file exists that it is named by; every time, if it is named "always"."""

    def run(self, **options):
        if os.path.exists(self.name):
            return super().run(**options)
        if self.name != "always":
            Path(self.name).touch()
        os.kill(os.getpid(), signal.SIGKILL)


def deadly(name):
    return Deadly(MODEL, SCENES[0].tgt, SCENES[0].corr, name=str(name))


COARSE = ibi.Model.from_mesh(*BOX, voxel=5)  # 200 scans are many


class DeadlyDetector(ibi.Detector):
    """Kills its worker over scan 50, until the file exists that it is named by."""

    def __init__(self, name):
        super().__init__(COARSE, max_instances=1)
        self.name = name

    def __call__(self, batch):
        if 50 in list(batch["scan_id"]) and not os.path.exists(self.name):
            Path(self.name).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().__call__(batch)


NUM_SCANS = 200


@pytest.fixture(scope="module")
def scans():
    """As many as there are of ten kinds, each with the pose that is found."""
    held = batch(range(10))
    found = ibi.Detector(COARSE, max_instances=1)(held)["target_from_source"]
    assert len(found) == 10
    rows = [
        {"scan_id": i, "points": held["points"][i % 10].ravel(), "viewpoint": np.zeros(3)}
        for i in range(NUM_SCANS)
    ]
    return rows, found


def check(found, poses):
    """None is lost, none is told twice, and each is what it is without a cluster."""
    order = np.argsort([row["scan_id"] for row in found])
    assert [int(found[i]["scan_id"]) for i in order] == list(range(NUM_SCANS))
    for i, row in enumerate(order):
        np.testing.assert_array_equal(np.asarray(found[row]["target_from_source"]), poses[i % 10])


# Dask ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def dask_client():
    pytest.importorskip("distributed", reason=NO_CLUSTERS)
    import dask
    from distributed import Client, LocalCluster

    # No dashboard and no files here; and a job that kills two workers is lost, not only one that kills four.
    dask.config.set({"distributed.scheduler.allowed-failures": 1})
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        yield client


def test_dask_gives_results_and_errors_in_order(dask_client):
    assert values(JOBS, dask_client.get_executor()) == EXPECTED
    assert values(iter(JOBS * 3), dask_client.get_executor(), window=4) == [
        one.replace("job 2", f"job {index}") if isinstance(one, str) else one
        for index, one in enumerate(EXPECTED * 3)
    ]


def test_dask_runs_the_job_of_a_worker_that_dies_again(dask_client, tmp_path):
    jobs = [deadly(tmp_path / "was here"), *JOBS[1:]]
    assert values(jobs, dask_client.get_executor(pure=False)) == EXPECTED


def test_dask_gives_up_a_job_that_kills_all_its_workers(dask_client):
    jobs = [deadly("always"), JOBS[1], JOBS[0], JOBS[1]]  # which Dask gives up with it
    first, *rest = ibi.register_batch(jobs, dask_client.get_executor())
    assert isinstance(first, ibi.JobError)
    assert type(first.error).__name__ == "KilledWorker"
    assert [content(one) for one in rest] == [EXPECTED[1], EXPECTED[0], EXPECTED[1]]


def test_dask_reads_files_where_the_job_runs(dask_client, tmp_path):
    (found,) = ibi.register_batch(
        [ibi.Job(MODEL, tmp_path / "none.ply", SCENES[0].corr)], dask_client.get_executor()
    )
    assert str(found) == f"job 0: {tmp_path / 'none.ply'}: no such file"


def test_dask_drops_what_waits_when_a_batch_is_closed(dask_client):
    found = ibi.register_batch(JOBS * 4, dask_client.get_executor(pure=False))
    assert content(next(found)) == EXPECTED[0]
    found.close()
    deadline = time.monotonic() + LIMIT_S
    while any(dask_client.processing().values()) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(dask_client.processing().values())


def by_rows(detect, rows):
    """A partition of a bag, as a dict of columns and back."""
    rows = list(rows)
    found = detect({name: [row[name] for row in rows] for name in rows[0]})
    return [dict(zip(found, values, strict=True)) for values in zip(*found.values(), strict=True)]


def test_a_dask_bag_loses_no_scan_with_a_worker(dask_client, scans, tmp_path):
    import dask.bag

    rows, poses = scans
    detect = DeadlyDetector(str(tmp_path / "was here"))
    bag = dask.bag.from_sequence(rows, partition_size=8)
    found = bag.map_partitions(lambda part: by_rows(detect, part)).compute()
    assert (tmp_path / "was here").exists()
    check(found, poses)


def bop_on(cluster, root, path):
    """Poses that `ibi bop` finds there."""
    result = run("bop", root, "-o", path, "--cluster", cluster)
    assert result.exit_code == 0, result.output
    assert "recall     " in result.stdout
    return [line.rsplit(",", 1)[0] for line in path.read_text().splitlines()]


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A set of BOP, and what is found without a cluster."""
    folder = tmp_path_factory.mktemp("sets")
    root = tiny_sets.bop(folder / "tiny")
    assert run("bop", root, "-o", folder / "a.csv", "--jobs", 1).exit_code == 0
    return root, [line.rsplit(",", 1)[0] for line in (folder / "a.csv").read_text().splitlines()]


def test_a_set_of_bop_is_found_on_dask(dask_client, tiny, tmp_path):
    root, wanted = tiny
    assert bop_on(dask_client.scheduler.address, root, tmp_path / "a.csv") == wanted


def test_a_dask_client_is_no_executor(dask_client):
    with pytest.raises(TypeError, match=r"of Dask client.get_executor\(\)"):
        ibi.register_batch(JOBS, dask_client)


# Ray -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ray():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_AUTH_MODE", "disabled")  # it would leave a token in the home directory
        patch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # its default warns of itself
        patch.setenv(
            "PYTHONPATH", os.path.dirname(__file__), prepend=os.pathsep
        )  # of the workers, for `Deadly`
        ray = pytest.importorskip("ray", reason=NO_CLUSTERS)
        ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, configure_logging=False)
        yield ray
        ray.shutdown()


def test_ray_gives_results_and_errors_in_order(ray):
    assert values(JOBS, ibi.RayExecutor()) == EXPECTED
    assert values(JOBS, ibi.RayExecutor, window=2) == EXPECTED


def test_ray_runs_the_job_of_a_worker_that_dies_again(ray, tmp_path):
    jobs = [deadly(tmp_path / "was here"), *JOBS[1:]]
    assert values(jobs, ibi.RayExecutor(max_retries=1)) == EXPECTED


def test_ray_gives_up_a_job_that_kills_all_its_workers(ray):
    jobs = [deadly("always"), JOBS[1]]
    first, *rest = ibi.register_batch(jobs, ibi.RayExecutor(max_retries=1, num_cpus=1))
    assert isinstance(first.error, ray.exceptions.WorkerCrashedError)
    assert str(first).startswith("job 0, always: WorkerCrashedError: The worker died")
    assert [content(one) for one in rest] == EXPECTED[1:2]


def test_ray_drops_what_waits_when_a_batch_is_closed(ray):
    executor = ibi.RayExecutor()
    found = ibi.register_batch(JOBS * 4, executor)
    assert content(next(found)) == EXPECTED[0]
    found.close()
    assert executor.submit(int, "3").result(LIMIT_S) == 3


def test_a_set_of_bop_is_found_on_ray(ray, tiny, tmp_path):
    root, wanted = tiny
    assert bop_on("ray", root, tmp_path / "a.csv") == wanted


# Neither -------------------------------------------------------------------------------------------------


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r"^Ray is needed: pip install 'ibi_rs\[ray\]'"):
        ibi.RayExecutor()
