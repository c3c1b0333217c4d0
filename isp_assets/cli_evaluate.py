"""The command line's measuring side. One function a verb; no logic."""

from pathlib import Path
from typing import Annotated, Any

import typer

evaluate_app = typer.Typer(no_args_is_help=True, help="Measure networks and fits.")

OutOption = Annotated[Path, typer.Option("--out", help="Output folder; made if missing.")]
BundlesOption = Annotated[list[Path], typer.Option("--bundle", help="Garment bundle; repeat.")]
DataOption = Annotated[Path, typer.Option("--data", help="Dataset folder with test garments.")]


@evaluate_app.command("reconstruction")
def reconstruction(
    data: DataOption,
    bundles: BundlesOption,
    out: OutOption,
    garments: Annotated[int, typer.Option(help="Garments measured, of training and of test each.")] = 20,
    finest: Annotated[int, typer.Option(help="Of these, how many at the finest resolution.")] = 6,
    resolutions: Annotated[str, typer.Option(help="Grid cells, separated by commas.")] = "128,256,512",
    samples: Annotated[int, typer.Option(help="Points on each surface.")] = 100_000,
    peer: Annotated[
        list[str] | None,
        typer.Option(help="FILE.py=ARGUMENT of a method to compare with; {category} is filled in. Repeat."),
    ] = None,
) -> None:
    """Rest shapes against the true garments: distances, normals, seams, time and memory (Table 1)."""
    from isp_assets.bundle import GarmentBundle
    from isp_assets.evaluate.paper import PAPER_SHIRTS
    from isp_assets.evaluate.reconstruction import (
        FIGURES,
        IspReconstructor,
        ReconstructionOptions,
        ReconstructionTable,
        evaluate_reconstruction,
        load_peer,
    )
    from isp_assets.evaluate.table import write_table
    from isp_assets.train.cpu import prepare_cpu
    from isp_assets.train.dataset import load_dataset

    prepare_cpu(1)
    options = ReconstructionOptions(
        resolutions=_numbers(resolutions), garments=garments, finest=finest,
        samples=samples,
    )  # fmt: skip
    whole = ReconstructionTable()
    for path in bundles:
        bundle = GarmentBundle.load(path)
        splits = {s: load_dataset(data, bundle.category, test=s == "test") for s in ("train", "test")}
        methods: list[Any] = [IspReconstructor(bundle)]
        methods += [load_peer(text, bundle.category) for text in peer or []]
        with _bar() as report:
            part = evaluate_reconstruction(methods, splits, options, progress=report)
        whole.rows += part.rows
        whole.garments += part.garments
        rows = [*whole.rows, *PAPER_SHIRTS]
        write_table(
            out, "reconstruction", rows, meanings=FIGURES, details={"garments": whole.garments}
        )  # after every category, so that a run that is cut off leaves what it has
    _print("reconstruction", [*whole.rows, *PAPER_SHIRTS])


@evaluate_app.command("decode")
def decode(
    bundles: BundlesOption,
    out: OutOption,
    data: Annotated[Path | None, typer.Option("--data", help="Dataset folder, for odd parameters.")] = None,
    pairs: Annotated[int, typer.Option(help="Pairs of garments to mix.")] = 200,
    steps: Annotated[int, typer.Option(help="Mixtures of a pair.")] = 50,
    random: Annotated[int, typer.Option(help="Random codes at every radius.")] = 100,
    seed: Annotated[int, typer.Option("--seed")] = 0,
) -> None:
    """Random, distant, mixed and odd codes at every resolution: how many give a good garment."""
    from isp_assets.bundle import GarmentBundle
    from isp_assets.evaluate.robustness import FIGURES, RobustnessOptions, evaluate_robustness
    from isp_assets.evaluate.table import write_table
    from isp_assets.train.cpu import prepare_cpu
    from isp_assets.train.dataset import load_dataset

    prepare_cpu(1)
    options = RobustnessOptions(pairs=pairs, steps=steps, random=random, seed=seed)
    rows: list[dict[str, Any]] = []
    errors: list[dict[str, Any]] = []
    for path in bundles:
        bundle = GarmentBundle.load(path)
        garments = None if data is None else load_dataset(data, bundle.category)
        with _bar() as report:
            found = evaluate_robustness(bundle, options, data=garments, progress=report)
        rows += found.rows
        errors += found.errors
        write_table(out, "decode", rows, meanings=FIGURES, details={"errors": errors})
    _print("decode", rows)


@evaluate_app.command("draping")
def draping(
    out: OutOption,
    tests: Annotated[str | None, typer.Option(help="Tests to run, as T1,T4; all without it.")] = None,
    collection: Annotated[str, typer.Option(help="Collection folder.")] = "default",
    folder: Annotated[Path | None, typer.Option("--motions", help="Folder of held-out clips.")] = None,
    clips: Annotated[str, typer.Option(help="Names of clips in that folder, separated by commas.")] = "",
    quick: Annotated[bool, typer.Option("--quick", help="Fewer values of every sweep.")] = False,
) -> None:
    """Stress tests of draping: the value at which every sweep first fails, and pictures of the worst."""
    from isp_assets.evaluate.draping import LIMITS, digest_of, evaluate_draping, layer_times
    from isp_assets.evaluate.stress_measures import FIGURES
    from isp_assets.evaluate.stress_tests import StressSetup, stress_cases
    from isp_assets.evaluate.table import write_table
    from isp_assets.train.cpu import prepare_cpu

    prepare_cpu(1)
    setup = StressSetup.load(collection, folder=folder, clips=_names(clips), quick=quick)
    cases = stress_cases(setup, _names(tests) if tests else None)
    with _bar() as report:
        table = evaluate_draping(cases, out, networks=digest_of(setup.collection.folder), progress=report)
    times = {"layer_times": layer_times(table.rows)}
    write_table(out, "draping", table.rows, meanings=FIGURES, details=times)
    write_table(out, "limits", table.limits, meanings=LIMITS, details=times)
    _print("limits of draping", table.limits)


@evaluate_app.command("physics")
def physics(
    out: OutOption,
    outfits: Annotated[
        list[str], typer.Option("--outfit", help="Garments, innermost first, as tank_top,trousers; repeat.")
    ],
    motion: Annotated[str, typer.Option(help="A built-in motion, or an .npz.")] = "walk",
    frames: Annotated[str, typer.Option(help="Frame range.")] = "11-20",
    reference: Annotated[
        str, typer.Option(help="'energy', or the name of an installed solver such as 'newton'.")
    ] = "newton",
    collection: Annotated[str, typer.Option(help="Collection folder.")] = "default",
    resolution: Annotated[int, typer.Option(help="Grid cells across a panel.")] = 96,
    hold_frames: Annotated[int, typer.Option(help="Frames whose rungs the solver starts from.")] = 2,
    hold_steps: Annotated[int, typer.Option(help="Steps with the pose held.")] = 60,
) -> None:
    """Each rung of draping against a physical equilibrium: energies, stretch, distances, time."""
    from isp_assets.evaluate.physics import FIGURES, HOLD_FIGURES, PhysicsOptions
    from isp_assets.evaluate.physics_task import PhysicsTask
    from isp_assets.evaluate.table import write_table
    from isp_assets.pipeline import split_names
    from isp_assets.train.cpu import prepare_cpu

    prepare_cpu(1)
    options = PhysicsOptions(hold_frames=hold_frames, hold_steps=hold_steps)
    task = PhysicsTask.load(reference, motion, frames, collection=collection, resolution=resolution)
    rows: list[dict[str, Any]] = []
    holds: list[dict[str, Any]] = []
    details: dict[str, Any] = {}
    for text in outfits:
        with _bar() as report:
            found = task.evaluate(split_names(text), options, progress=report)
        rows += [{"outfit": text, **row} for row in found.rows]
        holds += [{"outfit": text, **row} for row in found.holds]
        details[text] = found.details
        write_table(out, "physics", rows, meanings=FIGURES, details={"reference": details})
        if holds:
            write_table(out, "physics_starts", holds, meanings=HOLD_FIGURES, details={})
    _print("physics", rows)
    if holds:
        _print("rungs as a start for the solver", holds)


def _names(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(",") if part.strip())


def _numbers(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise typer.BadParameter(f"expected whole numbers, separated by commas; got {text!r}") from error


def _bar() -> Any:
    from collections.abc import Callable, Iterator
    from contextlib import contextmanager

    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    @contextmanager
    def running() -> Iterator[Callable[[int, int, str], None]]:
        columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
        with Progress(*columns, console=Console(stderr=True)) as bar:
            task = bar.add_task("starting", total=None)
            yield lambda done, total, text: bar.update(task, completed=done, total=total, description=text)

    return running()


def _print(title: str, rows: Any) -> None:
    from rich.console import Console
    from rich.table import Table

    from isp_assets.evaluate.table import cell

    columns = list(dict.fromkeys(key for row in rows for key in row))
    cells = [[cell(row.get(key)) for key in columns] for row in rows]
    console, table = Console(), Table(*columns, title=title)
    for texts in cells:
        table.add_row(*texts)
    unbounded = console.options.update(width=10_000)
    needed = console.measure(table, options=unbounded).maximum
    if needed > console.width and console.is_terminal:  # turned by a quarter, it can be read
        table = Table(*("" for _ in range(len(cells) + 1)), title=title, show_header=False)
        for name, *texts in zip(columns, *cells, strict=True):
            table.add_row(name, *texts)
    elif needed > console.width:  # a pipe has no width that lines must fit into
        console.width = needed
    console.print(table)
