"""The command line: one function a verb; it parses, calls the library, and prints.

Exit codes: 0 done; 2 wrong command line; 3 wrong input; 4 geometry or draping
failed; 5 training failed; 6 a plugin failed; 1 any other error raised on
purpose; 130 interrupted. Heavy packages are imported inside the commands, so
``--help`` stays quick.
"""

import sys
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from isp_assets.cli_evaluate import evaluate_app
from isp_assets.cli_fit import fit_app
from isp_assets.cli_train import dataset_app, train_app
from isp_assets.conventions import FrameRange
from isp_assets.errors import IspAssetsError

if TYPE_CHECKING:
    from isp_assets.shot import ShotJob

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Drape ordered stacks of implicit-sewing-pattern garments over SMPL motion.",
)
app.add_typer(dataset_app, name="dataset")
app.add_typer(train_app, name="train")
app.add_typer(fit_app, name="fit")
app.add_typer(evaluate_app, name="evaluate")
out_console = Console()
error_console = Console(stderr=True, soft_wrap=True)

_MOST_WORKERS = 8  # unless asked for more


class Device(str, Enum):
    """Where networks run."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


OutOption = Annotated[Path, typer.Option("--out", help="Output folder; made if missing.")]
FramesOption = Annotated[
    str | None, typer.Option("--frames", help="Frame range A-B or A-BxSTEP; overrides the file's.")
]
WriteOption = Annotated[
    str | None, typer.Option("--write", help="Writers, separated by commas: usd,glb,rerun,sheet.")
]
DeviceOption = Annotated[Device, typer.Option("--device", help="Where the networks run.")]
StepsOption = Annotated[
    str | None,
    typer.Option("--steps", help="Rungs to run, of skin,displace,tuck,layering,project (for comparisons)."),
]
WorkersOption = Annotated[
    int | None,
    typer.Option(
        min=1, help="Processes, 1 GB of memory each. [default: one a core, up to 8; 1 with smoothing]"
    ),
]
ResumeOption = Annotated[
    bool, typer.Option("--resume", help="Go on from the frames that an interrupted run has kept.")
]


@app.command()
def demo(
    out: OutOption,
    frames: FramesOption = None,
    write: WriteOption = None,
    device: DeviceOption = Device.auto,
    steps: StepsOption = None,
    workers: WorkersOption = None,
    resume: ResumeOption = False,
) -> None:
    """Drape the built-in outfit over the built-in walk and write every format."""
    shot = Path(__file__).parent / "data" / "demo.toml"
    drape(shot, out, frames, write, device, steps, workers=workers, resume=resume)


@app.command()
def drape(
    shot: Annotated[Path, typer.Argument(help="Shot file (TOML).")],
    out: OutOption,
    frames: FramesOption = None,
    write: WriteOption = None,
    device: DeviceOption = Device.auto,
    steps: StepsOption = None,
    smoothing: Annotated[
        float, typer.Option(help="Share of the frame before in what projection moves; .5 calms flicker.")
    ] = 0.0,
    strain: Annotated[
        float | None,
        typer.Option(help="Strain (p99) from which a layer is relaxed; .28 is faster. [default: 0.135]"),
    ] = None,
    workers: WorkersOption = None,
    resume: ResumeOption = False,
) -> None:
    """Drape a shot file and write NAME.usdc, .glb, .rrd, .png and report.json."""
    from dataclasses import replace

    from isp_assets.drape import DrapeOptions
    from isp_assets.pipeline import run_job, split_names
    from isp_assets.processes import available_cores
    from isp_assets.shot import ShotJob

    with out_console.status("loading"):
        job = ShotJob.load(shot, frames=FrameRange.parse(frames) if frames else None)
    if write is not None:
        job = replace(job, write=split_names(write))
    options = DrapeOptions(device=_device(device), smoothing=smoothing)
    if strain is not None:
        options = replace(options, strain=strain)
    if steps is not None:
        options = replace(options, steps=split_names(steps))
    with _progress() as (bar, task):
        try:
            report = run_job(
                job,
                out,
                options=options,
                resume=resume,
                workers=workers or (1 if smoothing else min(available_cores(), _MOST_WORKERS)),
                progress=lambda done, total: bar.update(task, completed=done, total=total),
            )
        except KeyboardInterrupt:
            if (kept := out / f"{job.shot.name}.frames").is_dir():
                error_console.print(f"finished frames are kept in {_plain(str(kept))}; go on with --resume")
            raise
    _print_report(report, job, out)


@app.command()
def garments(collection: Annotated[str, typer.Argument(help="Collection folder.")] = "default") -> None:
    """List the garments of a collection."""
    from isp_assets.collection import Collection

    loaded = Collection.load(collection)
    table = Table("garment", "bundle", "fabric", "about", title=f"collection {loaded.name}")
    for name in loaded.names():
        entry = loaded.entry(name)
        table.add_row(name, entry.bundle, entry.style.kind, entry.about)
    out_console.print(table)


@app.command()
def plugins() -> None:
    """List the writer plugins that were found, with their versions."""
    from isp_assets.plugin import find_writers

    table = Table("plugin", "version", "suffix", "from")
    for name, plugin in find_writers().items():
        suffix = plugin.writer.suffix if plugin.writer else f"[red]broken: {plugin.error}"
        table.add_row(name, plugin.version, suffix, plugin.origin)
    out_console.print(table)


def _device(device: Device) -> str:
    import torch

    available = torch.cuda.is_available()
    if device is Device.cuda and not available:
        raise typer.BadParameter("no CUDA device is available; use --device cpu", param_hint="--device")
    return "cuda" if available and device is not Device.cpu else "cpu"


def _print_report(report: dict[str, Any], job: "ShotJob", out: Path) -> None:
    table = Table(
        "layer", "in body % (max)", "in layers beneath % (max)", "crossing pairs (max)", "strain p99 (max)"
    )
    for layer in report["layers"]:
        row = report["summary"]["final"][layer["name"]]
        table.add_row(
            layer["name"],
            f"{row['body_area_percent']['mean']:.3f} ({row['body_area_percent']['max']:.3f})",
            f"{row['inner_area_percent']['mean']:.3f} ({row['inner_area_percent']['max']:.3f})",
            f"{row['crossing_pairs']['mean']:.1f} ({row['crossing_pairs']['max']:.0f})",
            f"{row['strain_p99']['mean']:.3f} ({row['strain_p99']['max']:.3f})",
        )
    out_console.print(table)
    seconds = report["seconds"]["total"]
    out_console.print(f"{len(report['frames'])} frames of [bold]{job.shot.name}[/] in {seconds:.1f} s")
    for file in report["files"].values():
        out_console.print(f"  {out / file['path']}  {file['bytes'] / 2**20:.1f} MiB")
    out_console.print(f"  {out / 'report.json'}")


def _progress() -> Any:
    from contextlib import contextmanager

    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    @contextmanager
    def running() -> Any:
        columns = (
            TextColumn("draping"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("frames"),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=out_console) as bar:
            yield bar, bar.add_task("draping", total=None)

    return running()


def main() -> None:
    """Run the command line; every error raised on purpose becomes one message and an exit code."""
    try:
        app()
    except IspAssetsError as error:
        error_console.print(f"[bold red]error:[/] {_plain(str(error))}", highlight=False)
        sys.exit(error.exit_code)


def _plain(text: str) -> str:
    from rich.markup import escape

    return escape(text)


if __name__ == "__main__":
    main()
