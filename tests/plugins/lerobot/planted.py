"""LeRobot data sets and calibration files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

MOTORS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
FPS = 30
COUNT_DEG = 360 / 4095


def command(random: np.random.Generator, count: int, span: float) -> np.ndarray:
    """A hand's motion: rests, and moves between them that begin and end softly (N, deg)."""
    values, at = np.empty(0), 0.0
    while len(values) < count:
        to = random.uniform(-span / 2, span / 2)
        rest, move = random.integers(15, 45), max(8, int(abs(to - at) / random.uniform(20, 60) * FPS))
        soft = (1 - np.cos(np.linspace(0, np.pi, move))) / 2
        values = np.concatenate([values, np.full(rest, at), at + (to - at) * soft])
        at = to
    tremor = np.convolve(random.normal(0, 0.08, count + 8), np.ones(9) / 9, mode="valid")
    return values[:count] + tremor


def episodes(count: int, frames: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Actions and states (N x motors each) of episodes."""
    random = np.random.default_rng(1)
    made = []
    for _ in range(count):
        action = np.column_stack([command(random, frames, 80.0) for _ in MOTORS])
        state = action + random.normal(0, 0.05, action.shape)
        made.append(tuple(np.round(values / COUNT_DEG) * COUNT_DEG for values in (action, state)))
    return made


def write_dataset(
    folder: Path, made: Sequence[tuple[np.ndarray, np.ndarray]], version: str = "v2.1", motors: Sequence[str] = MOTORS
) -> Path:
    """A data set in LeRobot's layout."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    tables, lengths, done = [], [], 0
    for episode, (action, state) in enumerate(made):
        count = len(action)
        numbers = {
            "timestamp": pa.array(np.arange(count, dtype=np.float32) / FPS),
            "frame_index": pa.array(np.arange(count)),
            "episode_index": pa.array(np.full(count, episode)),
            "index": pa.array(np.arange(done, done + count)),
        }
        vectors = {
            name: pa.FixedSizeListArray.from_arrays(pa.array(values.astype(np.float32).ravel()), values.shape[1])
            for name, values in (("action", action), ("observation.state", state))
        }
        if version == "v2.1":
            vectors = {name: values.cast(pa.list_(pa.float32())) for name, values in vectors.items()}
        tables.append(pa.table({**vectors, **numbers}))
        lengths.append(count)
        done += count
    (folder / "meta").mkdir(parents=True)
    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True)
    if version == "v2.1":
        for episode, table in enumerate(tables):
            pq.write_table(table, data / f"episode_{episode:06d}.parquet")
        lines = [json.dumps({"episode_index": i, "tasks": ["x"], "length": n}) for i, n in enumerate(lengths)]
        (folder / "meta" / "episodes.jsonl").write_text("\n".join(lines) + "\n")
    else:
        half = (len(tables) + 1) // 2
        for number, some in enumerate((tables[:half], tables[half:])):
            if some:
                pq.write_table(pa.concat_tables(some), data / f"file-{number:03d}.parquet")
        place = folder / "meta" / "episodes" / "chunk-000"
        place.mkdir(parents=True)
        starts = [sum(lengths[:i]) / FPS for i in range(len(lengths))]
        video = {"chunk_index": [0] * len(lengths), "file_index": [0] * len(lengths), "from_timestamp": starts}
        about = {"episode_index": list(range(len(lengths))), "length": lengths}
        about |= {f"videos/observation.images.front/{name}": values for name, values in video.items()}
        pq.write_table(pa.table(about), place / "file-000.parquet")
    feature: dict[str, Any] = {"dtype": "float32", "shape": [len(motors)], "names": [f"{m}.pos" for m in motors]}
    info = {
        "codebase_version": version if version == "v2.1" else "v3.0",
        "robot_type": "so101_follower",
        "total_episodes": len(made),
        "total_frames": done,
        "fps": FPS,
        "features": {"action": feature, "observation.state": feature, "observation.images.front": {"dtype": "video"}},
    }
    (folder / "meta" / "info.json").write_text(json.dumps(info, indent=4))
    return folder


def motor_entries(**changed: Mapping[str, int]) -> dict[str, dict[str, int]]:
    """A calibration of an arm with 200 deg a joint, as LeRobot writes it; ``changed`` has numbers by motor."""
    entries = {}
    for number, motor in enumerate(MOTORS, start=1):
        low, high = (0, 4095) if motor == "wrist_roll" else (910, 3185)
        entry = {
            "id": number,
            "drive_mode": 0,
            "homing_offset": 100 * number - 350,
            "range_min": low,
            "range_max": high,
        }
        entries[motor] = {**entry, **changed.get(motor, {})}
    return entries


def write_motors(path: Path, **changed: Mapping[str, int]) -> Path:
    """A calibration file."""
    path.write_text(json.dumps(motor_entries(**changed), indent=4))
    return path
