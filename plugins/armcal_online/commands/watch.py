"""``armcal watch``."""

import json
import signal
import sys
import threading
from pathlib import Path

import click
from armcal.cli.console import Screen, output_fault, say
from armcal.errors import InputError, Location
from armcal.version import JSON_SCHEMA

from armcal_online.watch.feed import Feed

DEFAULT_PORT = 8642
_REFRESH = 1.0


@click.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--host", default="127.0.0.1", show_default=True, help="Listen there; beyond this machine with a token.")
@click.option("--port", type=click.IntRange(0, 65535), default=DEFAULT_PORT, show_default=True, help="0: any free one.")
@click.option("--terminal", is_flag=True, help="Show it in this terminal; lines where this is none.")
@click.option("--wait", is_flag=True, help="Wait for a folder that is not there yet.")
@click.option("--once", is_flag=True, help="Print the present state and end.")
@click.option("--json", "as_json", is_flag=True, help="With --once: as JSON.")
def watch(folder: Path, host: str, port: int, terminal: bool, wait: bool, once: bool, as_json: bool) -> None:
    """Show a recalibration live: a page in the browser, or this terminal. DIR is its folder, which is only read."""
    where, hint = Location(str(folder)), "Give what armcal recalibrate was given as --out"
    if folder.exists() and not folder.is_dir():
        raise InputError("it is a file, expected the folder of a recalibration.", where=where, hint=f"{hint}.")
    if not folder.exists() and (once or not wait):
        raise InputError("there is no such folder.", where=where, hint=f"{hint}; with --wait it is waited for.")
    if as_json and not once:
        hint = "Programs follow events.jsonl in the folder itself."
        raise InputError("it is only for --once.", where=Location("--json"), hint=hint)
    if once:
        feed = Feed(folder)
        while feed.step():
            pass
        if as_json:
            click.echo(json.dumps({**JSON_SCHEMA, **feed.state()}, indent=2))
            return
        from armcal_online.watch.terminal import picture

        console = Screen()
        console.print(picture(feed.state(), console.width))
        return
    stop = threading.Event()
    earlier = signal.signal(signal.SIGTERM, lambda *_: stop.set())
    try:
        if terminal:
            _terminal(Feed(folder), stop)
        else:
            _serve(folder, host, port, stop)
    finally:
        stop.set()
        signal.signal(signal.SIGTERM, earlier)


def _terminal(feed: Feed, stop: threading.Event) -> None:
    """A picture that is drawn again and again; a line an event where the output is no terminal."""
    from rich.live import Live

    from armcal_online.watch.terminal import line, picture

    console = Screen()
    if console.is_terminal:
        with Live(console=console, screen=True, auto_refresh=False) as live:
            while not stop.is_set():
                while feed.step():
                    pass
                live.update(picture(feed.state(), console.width), refresh=True)
                stop.wait(_REFRESH)
    shown: str | None = None
    while not stop.is_set() and output_fault() is None:  # nobody reads lines after a fault
        messages = feed.step()
        for text in filter(None, map(line, messages)):
            say(text)
        standing = feed.waiting or feed.over
        if standing and standing != shown:
            say(standing, err=standing == feed.waiting)
        shown = standing
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
            server.shutdown()
