"""A made-up recalibration to watch: the folder that it leaves, and a server over it."""

from __future__ import annotations

import http.client
import json
import math
import random
import shutil
import threading
import time
from pathlib import Path
from typing import Any
from urllib.parse import quote

from armcal_online.watch.feed import Feed
from armcal_online.watch.server import WatchServer
from armcal_online.watch.shape import Shape, drawing_of

SLIP = 150


def made_up(count: int = 300, calibration: Path | None = None) -> list[dict[str, Any]]:
    """The events of a six-jointed arm whose third joint slips, with some outliers."""
    chance = random.Random(4)
    drawing = drawing_of(calibration) if calibration else None
    parameters = _made_up_parameters()
    events: list[dict[str, Any]] = [
        {
            "event": "started",
            "at": 1.8e9,
            "calibration": str(calibration or "calibration.yaml"),
            "level": "nominal",
            "gate": {"probability": 0.999},
            "parameters": parameters,
            "evaluator": "compiled",
            "sequence": 0,
            "resumed": False,
        }
    ]
    for n in range(1, count + 1):
        events += _made_up_record(n, chance, drawing)
        if n % 5 == 0:
            events.append(_made_up_estimate(n, chance, parameters))
    return events


def _made_up_parameters() -> list[dict[str, Any]]:
    names = [(f"arm.mdh.theta{i}", "rad", 0.001) for i in range(1, 7)]
    names += [(f"arm.mdh.d{i}", "m", 0.0002) for i in range(1, 7)]
    names += [(f"arm.spring.k{i}", "rad_per_Nm", 0.0008) for i in range(1, 7)]
    return [{"name": name, "unit": unit, "value": 0.1 * i, "sd": sd} for i, (name, unit, sd) in enumerate(names)]


def _made_up_record(n: int, chance: random.Random, drawing: Any) -> list[dict[str, Any]]:
    at = 1.8e9 + 15.0 * n
    angles = [0.9 * math.sin(0.031 * n + i) + (0.25 if i == 1 else 0.0) + 0.2 * chance.uniform(-1, 1) for i in range(6)]
    inputs = {f"arm.q{i + 1}": angle for i, angle in enumerate(angles)}
    tip = drawing(inputs)["arm"][-1] if drawing else [300.0 + 80 * math.sin(n), 100.0 * math.cos(n), 200.0]
    slipped, outlier = SLIP <= n < SLIP + 4, n % 61 == 17
    size = 9.0 if slipped else 30.0 if outlier else 0.5
    residual = [chance.gauss(0, size) for _ in range(3)]
    nis = sum(x * x for x in residual) / 0.25
    rejected = nis > 16.27
    record = {
        "event": "record",
        "sequence": n,
        "id": f"p{n}",
        "at": at,
        "verdict": "rejected" if rejected else "accepted",
        "why": f"NIS {nis:.1f} {'above' if rejected else 'within'} the gate of 16.27.",
        "nis": nis,
        "limit": 16.27,
        "dof": 3,
        "measurement": "tracker",
        "residual_mm": residual,
        "measured_mm": [a + b for a, b in zip(tip, residual, strict=True)],
        "predicted_mm": tip,
        "level": "suspect" if slipped else "nominal",
        "inputs": inputs,
    }
    if n % 97 == 40:
        dropped = ("nis", "limit", "dof", "residual_mm", "measured_mm", "predicted_mm", "inputs")
        record = {key: value for key, value in record.items() if key not in dropped}
        record |= {"verdict": "ignored", "why": "Its clock is an hour behind."}
    return [record, *_made_up_decisions(n, at)]


def _made_up_decisions(n: int, at: float) -> list[dict[str, Any]]:
    common = {"sequence": n, "at": at}
    if n == SLIP + 1:
        said = "2 of the last 8 records were rejected."
        return [{"event": "level", **common, "from": "nominal", "to": "suspect", "sentence": said}]
    if n == SLIP + 4:
        said = "Joint 3 slipped by 2.03 deg: its offset alone explains 97 % of what was rejected."
        slip = {"event": "decision", **common, "kind": "joint_slipped", "joint": "arm.q3", "size_deg": 2.03}
        back = {"event": "level", **common, "from": "suspect", "to": "nominal", "sentence": "The slip is followed."}
        return [{**slip, "sentence": said}, back, {"event": "calibration", **common, "path": "calibration.yaml"}]
    if n % 61 == 17:
        said = f"Record p{n} is an outlier: no joint explains it."
        return [{"event": "decision", **common, "kind": "outlier", "sentence": said}]
    return []


def _made_up_estimate(n: int, chance: random.Random, parameters: list[dict[str, Any]]) -> dict[str, Any]:
    values = {}
    for i, parameter in enumerate(parameters):
        slip = math.radians(2.03) * (1 - math.exp(-(n - SLIP) / 6)) if i == 2 and n > SLIP else 0.0
        sd = parameter["sd"] * (0.35 + 0.65 / math.sqrt(1 + n / 20))
        sd = parameter["sd"] * (0.35 + 8 * math.exp(-(n - SLIP) / 8)) if i == 2 and n > SLIP else sd
        wander = parameter["sd"] * (0.8 * math.sin(0.02 * n + i) + 0.15 * chance.gauss(0, 1)) * min(1, n / 60)
        values[parameter["name"]] = [parameter["value"] + wander + slip, sd]
    return {"event": "estimate", "sequence": n, "at": 1.8e9 + 15.0 * n, "parameters": values}


def written(events: list[dict[str, Any]]) -> str:
    return "".join(json.dumps(event) + "\n" for event in events)


def made_up_folder(folder: Path, count: int = 300, calibration: Path | None = None) -> Path:
    """A folder as a recalibration leaves it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "events.jsonl").write_text(written(made_up(count, calibration)))
    status = {"level": "nominal", "sequence": count, "records": count, "paused": False, "finished": False}
    (folder / "status.json").write_text(json.dumps(status))
    if calibration:
        shutil.copy(calibration, folder / "calibration.yaml")
    return folder


def append(path: Path, content: str) -> None:
    with path.open("a") as file:
        file.write(content)


def decision(sequence: int, sentence: str) -> dict[str, Any]:
    return {"event": "decision", "sequence": sequence, "at": 1.8e9, "kind": "drift", "sentence": sentence}


class Served:
    """A server over a folder, its threads, and plain requests to it."""

    def __init__(
        self, folder: Path, host: str = "127.0.0.1", shape: Shape | None = None, port: int = 0, patience: float = 10.0
    ) -> None:
        self.folder, self.feed = folder, Feed(folder, shape)
        self.server = WatchServer(self.feed, host, port, patience)
        self.stop = threading.Event()
        for run in (lambda: self.feed.follow(self.stop), lambda: self.server.serve_forever(0.02)):
            threading.Thread(target=run, daemon=True).start()

    def ask(
        self, path: str, method: str = "GET", host: str | None = None, **headers: str
    ) -> tuple[int, http.client.HTTPResponse, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.server.server_port, timeout=10)
        connection.request(method, path, headers={**({"Host": host} if host else {}), **headers})
        answer = connection.getresponse()
        return answer.status, answer, answer.read()

    def state(self, after: str = "") -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.ask(f"/state?after={quote(after)}")[2])
        return found

    def wait_for(self, sequence: int) -> dict[str, Any]:
        deadline = time.monotonic() + 10
        while time.monotonic() < deadline:
            state = self.state()
            if state["last"] and state["last"]["sequence"] >= sequence:
                return state
            time.sleep(0.02)
        raise AssertionError(f"record {sequence} never came")

    def tell(self, *events: dict[str, Any]) -> None:
        append(self.folder / "events.jsonl", written(list(events)))

    def close(self) -> None:
        self.stop.set()
        self.server.shutdown()
        self.server.server_close()
