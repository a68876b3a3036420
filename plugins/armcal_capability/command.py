"""``armcal capability``."""

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import click
from armcal.base.config_text import as_json
from armcal.cli.common import Console, command_line, overrides, speaking
from armcal.io.folder import reserved
from armcal.run.prepare import Stopwatch

from armcal_capability.capability_figures import DRAWN, designs_figure, quantity_figure, reach_figure
from armcal_capability.capability_page import areas_table, conclusions, quantity_table, render_page, show_table
from armcal_capability.drawing import Picture
from armcal_capability.loading import Task, load_task
from armcal_capability.outputs import data_files
from armcal_capability.quantities import BY_NAME
from armcal_capability.summary import design_summaries, summary_of
from armcal_capability.survey import Survey, survey

_DATA = ("map.csv", "map.npz", "areas.csv", "designs.csv", "capability.json", "capability.html")
_FIGURES = ("reach.png", "designs.png", *(f"{name}.png" for name in BY_NAME))
OURS = (*_DATA, *_FIGURES)


@click.command()
@click.argument("source", metavar="CALIBRATION|CONFIG", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Where the results go.")
@click.option(
    "--settings", type=click.Path(path_type=Path), help="A configuration whose sections capability and plan to take."
)
@overrides
@speaking
def capability(console: Console, source: Path, out: Path, settings: Path | None, overrides: tuple[str, ...]) -> None:
    """Map what an arm can do: its reach, sag, stiffness, accuracy and dexterity, in all and in areas, for designs."""
    watch = Stopwatch()
    kept = click.get_current_context().with_resource(reserved(out, OURS))
    import_module("matplotlib")  # if it is missing, the command ends now and not after the survey
    registry = console.registry()
    task = load_task(source, settings, overrides, registry)
    with console.progress() as progress:
        with watch.stage("survey"):
            surveyed = survey(task.subject, task.settings, progress)
        designs: dict[str, Survey] = {}
        with watch.stage("designs"):
            for name, subject in task.designs.items():

                def of_design(_: str, done: float, name: str = name) -> None:
                    progress(name, done)

                designs[name] = survey(subject, task.settings, of_design)
    content = {"source": str(source), **summary_of(surveyed, task.settings)}
    compared = design_summaries(designs)
    content["designs"] = {n: {**summary_of(d, task.settings), "areas": compared[n]} for n, d in designs.items()}
    with watch.stage("figures"):
        pictures = _pictures(task, surveyed, designs, compared)
    tables = [quantity_table(content)]
    if any(compared.values()):
        tables.insert(0, areas_table(compared, "Designs over the cells of each area that all of them reach"))
    elif content["areas"]:
        tables.insert(0, areas_table({"": content["areas"]}, "Areas"))
    sentences = conclusions(task.subject.name, content, compared)
    facts = {"command": command_line(), "files": ", ".join(sorted({str(file) for file in task.files}))}
    facts |= {"samples": str(task.settings.samples), "seed": str(task.settings.seed)}
    page = render_page("Capability", task.subject.name, sentences, tables, pictures, facts)
    files: dict[str, str | bytes] = {f"{picture.name}.png": picture.png for picture in pictures}
    files |= data_files(surveyed, designs, content)
    kept.place({**files, "capability.json": as_json(content) + "\n", "capability.html": page})
    console.result({**content, "folder": str(out)})
    for table in tables:
        show_table(console, table)
    for text in sentences:
        console.out.print(text, markup=False, soft_wrap=True)
    for stage, seconds in watch.seconds.items():
        console.detail(f"{stage}: {seconds:.1f} s")
    console.out.print(f"page: {out / 'capability.html'}  ({watch.total():.1f} s)", markup=False, soft_wrap=True)


def _pictures(
    task: Task, surveyed: Survey, designs: Mapping[str, Survey], compared: Mapping[str, Mapping[str, Any]]
) -> tuple[Picture, ...]:
    pictures = []
    if designs:
        text = "Left: how far each design's tool comes, seen from the side. Right: how much of each area it reaches."
        pictures.append(Picture("designs", "Designs", designs_figure(designs, compared, task.settings), text))
    text = "Two sections through the workspace; the darker, the more postures of the sample bring the tool there."
    pictures.append(Picture("reach", "Reach", reach_figure(surveyed, task.settings), text))
    for name in DRAWN:
        if name in surveyed.voxels.values:
            quantity = BY_NAME[name]
            dark = "the darker, the more" if quantity.good == "low" else "the darker, the less"
            text = f"Two sections through the workspace: {quantity.words}; {dark}. Mean over the postures of each cell."
            title = quantity.words[0].upper() + quantity.words[1:]
            pictures.append(Picture(name, title, quantity_figure(surveyed, task.settings, name), text))
    return tuple(pictures)
