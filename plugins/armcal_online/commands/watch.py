"""``armcal watch``."""

from __future__ import annotations

import json
import signal
import sys
import threading
from pathlib import Path

import click
from armcal.cli.console import Screen
from armcal.cli.outlet import say
from armcal.errors import InputError, Location

from armcal_online.watch.feed import Feed

DEFAULT_PORT = 8642
_REFRESH = 1.0


@click.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--host", default="127.0.0.1", show_default=True, help="Listen there; beyond this machine with a token.")
@click.option("--port", type=click.IntRange(0, 65535), default=DEFAULT_PORT, show_default=True, help="0: any free one.")
@click.option("--terminal", is_flag=True, help="Show it in this terminal; lines where this is none.")
@click.option("--once", is_flag=True, help="Print the present state and end.")
@click.option("--json", "as_json", is_flag=True, help="With --once: as JSON.")
def watch(folder: Path, host: str, port: int, terminal: bool, once: bool, as_json: bool) -> None:
    """Show a recalibration live: a page in the browser, or this terminal. DIR is its folder, which is only read."""
    _check(folder, once, as_json)
    if once:
        _print_once(Feed(folder), as_json)
        return
    stop = threading.Event()
    earlier = signal.signal(signal.SIGTERM, lambda *_: stop.set())
    try:
        if terminal:
            _terminal(Feed(folder), stop)
        else:
            _serve(folder, host, port, stop)
    except KeyboardInterrupt:
        click.echo("", err=True)
    finally:
        stop.set()
        signal.signal(signal.SIGTERM, earlier)


def _check(folder: Path, once: bool, as_json: bool) -> None:
    if folder.exists() and not folder.is_dir():
        raise InputError(
            "it is a file, expected the folder of a recalibration.",
            where=Location(str(folder)),
            hint="Give what armcal recalibrate was given as --out.",
        )
    if once and not folder.exists():
        raise InputError(
            "there is no such folder.",
            where=Location(str(folder)),
            hint="Give what armcal recalibrate was given as --out; without --once it is waited for.",
        )
    if as_json and not once:
        raise InputError(
            "it is only for --once.",
            where=Location("--json"),
            hint="Programs follow events.jsonl in the folder itself.",
        )


def _print_once(feed: Feed, as_json: bool) -> None:
    while feed.step():
        pass
    state = feed.state()
    if as_json:
        click.echo(json.dumps(state, indent=2))
        return
    from armcal_online.watch.terminal import picture

    console = Screen()
    console.print(picture(state, console.width))


def _terminal(feed: Feed, stop: threading.Event) -> None:
    console = Screen()
    if not console.is_terminal:
        _lines(feed, stop)
        return
    from rich.live import Live

    from armcal_online.watch.terminal import picture

    with Live(console=console, screen=True, auto_refresh=False) as live:
        while not stop.is_set():
            while feed.step():
                pass
            live.update(picture(feed.state(), console.width), refresh=True)
            stop.wait(_REFRESH)


def _lines(feed: Feed, stop: threading.Event) -> None:
    from armcal_online.watch.terminal import line

    told: str | None = None
    while not stop.is_set() and getattr(sys.stdout, "fault", None) is None:  # who went away reads no more
        messages = feed.step()
        for text in filter(None, map(line, messages)):
            say(text)
        if feed.waiting and feed.waiting != told:
            say(feed.waiting, err=True)
        told = feed.waiting
        if not messages:
            sys.stdout.flush()
            stop.wait(_REFRESH)


def _serve(folder: Path, host: str, port: int, stop: threading.Event) -> None:
    from armcal_online.watch.server import WatchServer
    from armcal_online.watch.shape import Shape

    feed = Feed(folder, Shape(folder))
    with WatchServer(feed, host, port) as server:
        threads = [threading.Thread(target=feed.follow, args=(stop,), daemon=True)]
        threads.append(threading.Thread(target=server.serve_forever, daemon=True))
        for thread in threads:
            thread.start()
        say(f"Watching {folder}: {server.address}")
        sys.stdout.flush()
        try:
            while not stop.wait(_REFRESH):
                pass
        finally:
            server.ending.set()
            server.shutdown()
