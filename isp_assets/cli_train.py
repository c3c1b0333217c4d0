"""The command line's making side: training data, networks, bundles. One function a verb; no logic."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from isp_assets.train.loop import RunOptions

dataset_app = typer.Typer(no_args_is_help=True, help="Make training garments.")
train_app = typer.Typer(no_args_is_help=True, help="Train the networks of a bundle.")

OutOption = Annotated[Path, typer.Option("--out", help="Output folder; made if missing.")]
DataOption = Annotated[Path, typer.Option("--data", help="Dataset folder, as `dataset make` writes it.")]
CategoryOption = Annotated[str, typer.Option("--category", help="top, skirt or trousers.")]
MinutesOption = Annotated[float | None, typer.Option("--minutes", help="Training time; or give --steps.")]
StepsOption = Annotated[int | None, typer.Option("--steps", help="Number of steps; or give --minutes.")]
SeedOption = Annotated[int, typer.Option("--seed")]
ResumeOption = Annotated[bool, typer.Option("--resume", help="Go on from the folder's checkpoint.")]
BodyOption = Annotated[str, typer.Option("--body", help='"default" or an SMPL .npz or .pkl file.')]
DeviceOption = Annotated[str, typer.Option("--device", help="cpu or cuda.")]
RateOption = Annotated[float, typer.Option("--rate", help="Peak learning rate.")]

MotionsOption = Annotated[
    Path | None, typer.Option("--motions", help="Folder of further motions (AMASS-style .npz).")
]
HoldOutOption = Annotated[
    str, typer.Option("--hold-out", help="Motions kept for the test, separated by commas.")
]

_NOISY_HOLD = 0.2  # share of a run at its peak rate: noisy losses want a long decay


@dataset_app.command("make")
def make(
    out: OutOption,
    tops: Annotated[int, typer.Option(help="Shirts and jackets; the first ten are named.")] = 400,
    skirts: Annotated[int, typer.Option(help="Skirts; the first five are named.")] = 300,
    trousers: Annotated[int, typer.Option(help="Trousers; the first five are named.")] = 200,
    test: Annotated[int, typer.Option(help="Further garments of each, kept for testing.")] = 20,
    seed: SeedOption = 0,
    body: Annotated[str, typer.Option(help='"default" or an SMPL .npz or .pkl file.')] = "default",
    workers: Annotated[int, typer.Option(help="Processes, one thread each.")] = 2,
    edge_length: Annotated[float, typer.Option(help="Triangle side [m].")] = 0.018,
) -> None:
    """Draw two-panel patterns, drape them on the rest body, and store them. Run again to resume."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from isp_assets.train.dataset import make_dataset

    counts = {"top": tops, "skirt": skirts, "trousers": trousers}
    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns) as bar:
        task = bar.add_task("starting", total=None)
        make_dataset(
            out,
            counts={category: count for category, count in counts.items() if count},
            test=test,
            seed=seed,
            body=body,
            workers=workers,
            edge_length=edge_length,
            progress=lambda done, total, text: bar.update(
                task, completed=done, total=total, description=text
            ),
        )


@dataset_app.command("sheet")
def sheet(
    data: DataOption,
    category: CategoryOption,
    out: Annotated[Path, typer.Option("--out", help="PNG to write.")],
    count: Annotated[int, typer.Option(help="Garments to draw.")] = 12,
    seed: SeedOption = 0,
) -> None:
    """Draw a random sample of a data set: flat panels, and the rest shapes from both sides."""
    from isp_assets.train.dataset import load_dataset
    from isp_assets.train.dataset_sheet import draw_sheet

    draw_sheet(load_dataset(data, category), out, count=count, seed=seed)


@train_app.command("patterns")
def patterns(
    data: DataOption,
    category: CategoryOption,
    out: OutOption,
    minutes: MinutesOption = None,
    steps: StepsOption = None,
    seed: SeedOption = 0,
    resume: ResumeOption = False,
    device: DeviceOption = "cpu",
    width: Annotated[int, typer.Option(help="Width of the panel fields.")] = 128,
) -> None:
    """Train the panel fields of a category and a latent code for each garment (Eqs. 1-2)."""
    from isp_assets.train.dataset import load_dataset
    from isp_assets.train.patterns import PatternOptions, train_patterns

    run = _run(minutes, steps, seed, resume, device)
    train_patterns(load_dataset(data, category), out, run=run, options=PatternOptions(width=width))


@train_app.command("atlas")
def atlas(
    data: DataOption,
    category: CategoryOption,
    out: OutOption,
    patterns: Annotated[
        Path | None, typer.Option("--patterns", help="Output folder of `train patterns`.")
    ] = None,
    bundle: Annotated[
        Path | None, typer.Option("--bundle", help="Instead of patterns: a bundle, to train its atlases on.")
    ] = None,
    minutes: MinutesOption = None,
    steps: StepsOption = None,
    seed: SeedOption = 0,
    resume: ResumeOption = False,
    device: DeviceOption = "cpu",
    width: Annotated[int | None, typer.Option(help="Width of new atlases. [default: 128]")] = None,
    batch: Annotated[int, typer.Option(help="Garments a step; a GPU takes 96 in nearly the same time.")] = 24,
    rate: Annotated[
        float | None, typer.Option(help="Peak learning rate. [default: .003; with --bundle .001]")
    ] = None,
) -> None:
    """Train the maps from the panels to the rest body: CATEGORY.safetensors, a bundle (Eqs. 3-4)."""
    from isp_assets.bundle import GarmentBundle
    from isp_assets.train.atlas import FURTHER_RATE, AtlasOptions, train_atlas, train_atlas_further
    from isp_assets.train.dataset import load_dataset
    from isp_assets.train.loop import CHECKPOINT

    run = _run(minutes, steps, seed, resume, device)
    if bundle is not None and width is not None:
        raise typer.BadParameter("the atlases of a bundle keep their width; leave --width out")
    if patterns is not None and bundle is None:
        defaults = AtlasOptions()
        options = AtlasOptions(
            width=width or defaults.width, garments_per_step=batch, rate=rate or defaults.rate
        )
        train_atlas(load_dataset(data, category), patterns / CHECKPOINT, out, run=run, options=options)
    elif bundle is not None and patterns is None:
        options = AtlasOptions(garments_per_step=batch, rate=rate or FURTHER_RATE)
        further = GarmentBundle.load(bundle)
        train_atlas_further(load_dataset(data, category), further, out, run=run, options=options)
    else:
        raise typer.BadParameter("give either --patterns or --bundle")


@train_app.command("skin")
def skin(
    out: OutOption,
    minutes: MinutesOption = None,
    steps: StepsOption = None,
    seed: SeedOption = 0,
    resume: ResumeOption = False,
    device: DeviceOption = "cpu",
    body: BodyOption = "default",
) -> None:
    """Train the diffused skinning of a body: skin.safetensors (Eqs. 6-7)."""
    from isp_assets.body import Body
    from isp_assets.train.skin import rest_poses_of_categories, train_skin

    run = _run(minutes, steps, seed, resume, device)
    train_skin(out, run, body=Body.load(body), rest_poses=rest_poses_of_categories())


@train_app.command("drape")
def drape(
    bundle: Annotated[Path, typer.Option("--bundle", help="Garment bundle of the category.")],
    skin: Annotated[Path, typer.Option("--skin", help="Skin bundle of the body.")],
    out: OutOption,
    minutes: MinutesOption = None,
    steps: StepsOption = None,
    seed: SeedOption = 0,
    resume: ResumeOption = False,
    device: DeviceOption = "cpu",
    body: BodyOption = "default",
    motions: MotionsOption = None,
    hold_out: HoldOutOption = "",
    garments: Annotated[int, typer.Option(help="Garments to learn from.")] = 60,
    rate: RateOption = 1e-3,
) -> None:
    """Train a category's displacements on physics alone: CATEGORY.safetensors (Eq. 8)."""
    from dataclasses import replace

    from isp_assets.body import Body
    from isp_assets.bundle import GarmentBundle, SkinBundle
    from isp_assets.pipeline import split_names
    from isp_assets.train.displacement import DisplacementOptions, train_displacement
    from isp_assets.train.poses import PoseSource
    from isp_assets.train.wardrobe import WardrobeOptions

    run = replace(_run(minutes, steps, seed, resume, device), hold=_NOISY_HOLD)
    options = DisplacementOptions(
        wardrobe=WardrobeOptions(garments=garments),
        poses=PoseSource(motions, held_out=split_names(hold_out)),
        learning_rate=rate,
    )
    train_displacement(
        GarmentBundle.load(bundle), SkinBundle.load(skin), out, run, body=Body.load(body), options=options
    )


@train_app.command("carry")
def carry(
    old: Annotated[Path, typer.Option("--from", help="Bundle whose displacement network is carried over.")],
    bundle: Annotated[Path, typer.Option("--bundle", help="Bundle with new pattern networks.")],
    out: Annotated[Path, typer.Option("--out", help="Bundle to write.")],
    maps: Annotated[int | None, typer.Option(help="Fixed maps to keep; all if left out.")] = None,
) -> None:
    """Carry displacements over to retrained pattern networks, to train them further from there."""
    from isp_assets.bundle import GarmentBundle
    from isp_assets.train.carry import carry_displacement
    from isp_assets.train.fewer_maps import keep_fewer_maps

    first = GarmentBundle.load(old)
    carried = carry_displacement(first, GarmentBundle.load(bundle))
    if carried.drape_field is first.drape_field:
        typer.echo("both have the same codes; the displacements are taken as they are")
    else:
        notes = carried.provenance["carried"]
        typer.echo(f"{notes['garments']} garments shared; {notes['unexplained']:.1%} of codes unexplained")
    if maps is not None:
        carried, lost = keep_fewer_maps(carried, maps)
        typer.echo(f"{maps} maps lose {lost:.2%} of the mean square displacement")
    carried.save(out)


@train_app.command("layering")
def layering_network(
    bundles: Annotated[
        list[Path], typer.Option("--bundle", help="Garment bundle with displacements; repeat.")
    ],
    skin: Annotated[Path, typer.Option("--skin", help="Skin bundle of the body.")],
    out: OutOption,
    minutes: MinutesOption = None,
    steps: StepsOption = None,
    seed: SeedOption = 0,
    resume: ResumeOption = False,
    device: DeviceOption = "cpu",
    body: BodyOption = "default",
    motions: MotionsOption = None,
    hold_out: HoldOutOption = "",
    layering: Annotated[
        Path | None, typer.Option("--layering", help="A layering bundle to train further.")
    ] = None,
    rate: RateOption = 1e-3,
) -> None:
    """Train the layering network on random stacks of all bundles: layering.safetensors (Eqs. 9-12)."""
    from dataclasses import replace

    from isp_assets.body import Body
    from isp_assets.bundle import GarmentBundle, LayeringBundle, SkinBundle
    from isp_assets.pipeline import split_names
    from isp_assets.train.layering import LayeringOptions, train_layering
    from isp_assets.train.poses import PoseSource

    run = replace(_run(minutes, steps, seed, resume, device), hold=_NOISY_HOLD)
    options = LayeringOptions(poses=PoseSource(motions, held_out=split_names(hold_out)), learning_rate=rate)
    garments = [GarmentBundle.load(bundle) for bundle in bundles]
    earlier = LayeringBundle.load(layering) if layering else None
    train_layering(
        garments, SkinBundle.load(skin), out, run, body=Body.load(body), options=options, earlier=earlier
    )


def _run(minutes: float | None, steps: int | None, seed: int, resume: bool, device: str) -> "RunOptions":
    from isp_assets.train.loop import RunOptions

    return RunOptions(steps=steps, minutes=minutes, seed=seed, resume=resume, device=device)
