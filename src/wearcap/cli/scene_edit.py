"""`wearcap scene edit`: the page on which objects are cut out of a scan and their degrees of freedom are set."""

from pathlib import Path

from wearcap.cli.main import add_page
from wearcap.cli.verbs import Arguments
from wearcap.errors import WearcapError


def main(arguments: list[str]) -> None:
    parser = Arguments(
        prog="wearcap scene edit",
        description="Make an interactive environment of a scan, in the browser: cut objects out, set how they "
        "move, try it. It saves automatically; opened again, it continues.",
    )
    parser.add_argument("scene", help="the scene's folder with pointcloud.ply, or a .ply or .pcd file")
    parser.add_argument(
        "--environment", help="the file to make or to go on with (default: environment.json beside the scan)"
    )
    parser.add_argument("--metres-per-unit", type=float, help="of a scan in another unit (0.001 for millimetres)")
    add_page(parser, 8080, host=True)
    options = parser.parse_args(arguments)

    from wearcap.apps.scene_editor.editor import ObjectEditor
    from wearcap.io.formats.environment import FILE_NAME
    from wearcap.io.formats.scene_folder import cloud_file, read_scan

    cloud = cloud_file(options.scene)
    file = Path(options.environment) if options.environment else cloud.parent / FILE_NAME
    if file.is_dir():
        file /= FILE_NAME
    if file.suffix != ".json":
        raise WearcapError("an environment is a .json file", where=file, expected="environment.json or a folder")
    scan = read_scan(cloud, metres_per_unit=options.metres_per_unit)
    page = ObjectEditor(scan, file, title=cloud.parent.resolve().name, host=options.host, port=options.port)
    print(f"{cloud}: open {page.url} (Ctrl+C ends; objects are saved in {file})")
    page.serve()
