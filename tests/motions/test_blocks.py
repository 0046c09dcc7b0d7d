"""Blocks: on disk and taken up again, on a Dask cluster, and the same to the last bit however they were made."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from capsule_id.commands.bifurcate import client_of
from capsule_id.errors import InputError
from capsule_id.motions import sweep as blocks
from capsule_id.motions.response import Settling
from capsule_id.motions.sweep import motion_map, sweep_points
from capsule_id.physics.model import CapsuleParameters, Excitation

P = CapsuleParameters(m1=0.11, m2=0.53, k1=1420.0, k2=18960.0, c=3.89, mu=0.66, v_s=0.3, G=1e-3)
E = Excitation(4.0, 34.56)
QUICK = Settling(dropped=10, observed=6, exponent_periods=0)
OVER = {"k2": np.linspace(1e3, 55e3, 10), "P_d": np.linspace(1.0, 8.0, 9)}


@pytest.fixture(scope="module")
def whole() -> xr.Dataset:
    """The map computed in one block."""
    return motion_map(P, E, OVER, settling=QUICK, block=90)


def test_blocks_cannot_be_seen_in_the_result(whole: xr.Dataset) -> None:
    told: list[tuple[int, int, str]] = []
    data = motion_map(P, E, OVER, settling=QUICK, block=37, progress=lambda *step: told.append(step))
    xr.testing.assert_identical(data, whole)
    assert told == [(0, 90, "points"), (37, 90, "points"), (74, 90, "points"), (90, 90, "points")]


def test_an_interrupted_map_goes_on_from_its_finished_blocks(
    whole: xr.Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = tmp_path / "map.partial"

    def stop(done: int, total: int, what: str) -> None:
        if done >= 40:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        motion_map(P, E, OVER, settling=QUICK, block=20, store=store, progress=stop)
    finished = sorted(path.name for path in store.glob("block_*"))
    assert finished == ["block_000000000.npz", "block_000000020.npz"]
    # One block is damaged as a full disk would leave it: it is computed again, the other is not.
    (store / finished[1]).write_bytes((store / finished[1]).read_bytes()[:100])
    sizes: list[int] = []
    compute = blocks.settled_block
    monkeypatch.setattr(
        blocks, "settled_block", lambda points, *rest: sizes.append(points.size) or compute(points, *rest)
    )
    data = motion_map(P, E, OVER, settling=QUICK, block=20, store=store)
    assert sizes == [20, 20, 20, 10]
    xr.testing.assert_identical(data, whole)
    sizes.clear()
    xr.testing.assert_identical(motion_map(P, E, OVER, settling=QUICK, block=20, store=store), whole)
    assert sizes == []


def test_a_store_serves_its_own_points_only(tmp_path: Path) -> None:
    points, keep = sweep_points(P, E, {"k2": np.array([1e4, 2e4])}), ("label",)
    store = tmp_path / "store"
    blocks.compute(points, QUICK, keep, store=store)
    other = sweep_points(P, E, {"k2": np.array([1e4, 2.0001e4])})
    for changed in (
        {"points": other, "settling": QUICK, "keep": keep},
        {"points": points, "settling": Settling(dropped=11, observed=6), "keep": keep},
        {"points": points, "settling": QUICK, "keep": ("period",)},
    ):
        with pytest.raises(InputError, match="same points only"):
            blocks.compute(**changed, store=store)
    (store / blocks.FINGERPRINT).write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match="same points only"):
        blocks.compute(points, QUICK, keep, store=store)
    (tmp_path / "letter.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(InputError, match="a new folder"):
        blocks.compute(points, QUICK, keep, store=tmp_path)


def test_a_cluster_of_threads_gives_the_same_map(whole: xr.Dataset, tmp_path: Path) -> None:
    with client_of("threads") as client:
        data = motion_map(P, E, OVER, settling=QUICK, block=20, client=client, store=tmp_path / "store")
    xr.testing.assert_identical(data, whole)
    assert len(list((tmp_path / "store").glob("block_*.npz"))) == 5


def test_an_address_where_nobody_answers() -> None:
    with pytest.raises(InputError, match="the address of a Dask scheduler"), client_of("nowhere:1:2"):
        pass


def killed_on_the_way(over: dict[str, np.ndarray], settling: Settling, block: int) -> xr.Dataset:
    """The map through a cluster of processes of which one is killed when a quarter is done."""
    killed: list[int] = []
    with client_of("processes") as client:
        pids = list(client.run(os.getpid).values())
        assert len(pids) >= 2, "with one worker there is nobody to take over"

        def kill(done: int, total: int, what: str) -> None:
            if total // 4 < done < total // 2 and not killed:
                killed.append(pids[0])
                os.kill(pids[0], signal.SIGKILL)

        data = motion_map(P, E, over, settling=settling, block=block, client=client, progress=kill)
        # It was this cluster's worker, and it is gone (another process stands in its place, or will).
        assert killed == pids[:1]
        assert pids[0] not in client.run(os.getpid).values()
    return data


@pytest.mark.slow
def test_a_map_of_200_x_200_through_a_cluster_that_loses_a_worker() -> None:
    over = {"k2": np.linspace(1e3, 55e3, 200), "P_d": np.linspace(1.0, 8.0, 200)}
    settling = Settling(dropped=40, observed=12, exponent_periods=0)
    alone = motion_map(P, E, over, settling=settling)
    data = killed_on_the_way(over, settling, block=1024)
    xr.testing.assert_identical(data, alone)
    assert (alone["label"] != "failed").all()
