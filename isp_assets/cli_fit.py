"""The command line's fitting side: codes from foreign garments. One function a verb; no logic."""

from pathlib import Path
from typing import Annotated

import typer

fit_app = typer.Typer(no_args_is_help=True, help="Recover the latent code of a garment.")


@fit_app.callback()
def fit() -> None:
    """Recover the latent code of a garment."""


@fit_app.command("mesh")
def mesh(
    target: Annotated[Path, typer.Argument(help="Mesh in rest pose: OBJ, PLY, STL, GLB, OFF, VTK or VTU.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Code file to write (.safetensors).")],
    collection: Annotated[
        str, typer.Option(help="Collection whose networks are used, unless --add-to exists.")
    ] = "default",
    category: Annotated[
        str | None, typer.Option(help="top, skirt or trousers; found by likeness if left out.")
    ] = None,
    align: Annotated[
        str, typer.Option(help='"auto", or UNIT[,UP[,TURN]] of the mesh, as in "m" or "cm,z,180".')
    ] = "auto",
    name: Annotated[str | None, typer.Option(help="Name of the garment; the file's, if left out.")] = None,
    add_to: Annotated[
        Path | None,
        typer.Option(help="Collection folder to add the garment to; made as a copy of the other if missing."),
    ] = None,
    preview: Annotated[
        Path | None, typer.Option(help="Also write the decoded garment as a mesh (.obj, .ply, .glb, ...).")
    ] = None,
) -> None:
    """Fit a code to a garment mesh in the rest pose, and say how close it comes."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from isp_assets.alignment import Alignment
    from isp_assets.collection import Collection
    from isp_assets.fit import Fitter, choose_bundle
    from isp_assets.mesh_file import check_writable, read_surface, write_surface
    from isp_assets.train.cpu import prepare_cpu

    prepare_cpu(1)
    garment_name = name or target.stem
    loaded = Collection.load(collection)
    given = None if align == "auto" else Alignment.parse(align)
    wardrobe = Collection.load(add_to) if add_to is not None and add_to.exists() else None
    if preview is not None:
        check_writable(preview)
    if add_to is not None:  # what cannot be added is refused before the work, not after it
        (wardrobe or loaded).check_new_name(garment_name)
    surface = read_surface(target)
    bundle = choose_bundle(wardrobe or loaded, surface, category=category, alignment=given)
    columns = (TextColumn("fitting"), BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("starting", total=1.0)
        fitter = Fitter(bundle)
        found = fitter.fit(
            surface,
            alignment=given,
            progress=lambda share, text: bar.update(task, completed=share, description=text),
        )
    for line in found.summary(bundle.category):
        typer.echo(line)
    code = found.as_code(bundle, garment_name)
    code.save(output)
    if preview is not None:
        write_surface(preview, found.surface)
    if add_to is not None:
        (wardrobe or loaded.copy_to(add_to)).add(code)
