"""Raster tiles come from the user's own file; other files are refused in one line."""

import pytest
from pmtiles.tile import Compression, TileType, zxy_to_tileid
from pmtiles.writer import Writer

from socast.core.errors import SettingsError
from socast.tools.workbench.fleet.tiles import TileFile
from socast.tools.workbench.jobs import Jobs
from socast.tools.workbench.json_routes import Workbench
from socast.tools.workbench.workspace import Workspace
from tests.support.web_requests import Client
from tests.support.workbenches import serve

PICTURE = b"\x89PNG not really"


def write_tiles(path, kind=TileType.PNG):
    """Write a map with one tile."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.write_tile(zxy_to_tileid(1, 0, 1), PICTURE)
        ends = dict.fromkeys(
            ("min_lon_e7", "min_lat_e7", "max_lon_e7", "max_lat_e7", "center_lon_e7", "center_lat_e7"), 0
        )
        header = {
            "tile_type": kind,
            "tile_compression": Compression.NONE,
            "min_zoom": 1,
            "max_zoom": 1,
            "center_zoom": 1,
        }
        writer.finalize(header | ends, {"attribution": "Our survey"})
    return path


def test_tiles_of_the_file_are_served_with_its_zoom_levels(tmp_path):
    tiles = TileFile(write_tiles(tmp_path / "city.pmtiles"))
    with serve(Workbench(Workspace(), Jobs(), tiles=tiles)) as server:
        client = Client(server)
        known = client.get("/api/session").record()["tiles"]
        found, missing, beyond = (client.get(f"/tiles/{place}") for place in ("1/0/1", "1/1/1", "9/0/0"))
        stranger = Client(server, enters=False).get("/tiles/1/0/1")
    assert known == {"least_zoom": 1, "most_zoom": 1, "attribution": "Our survey"}
    assert (found.code, found.headers["content-type"], found.content) == (200, "image/png", PICTURE)
    assert (missing.code, beyond.code, stranger.code) == (204, 204, 403)


def test_vector_tiles_are_refused_with_the_remedy(tmp_path):
    with pytest.raises(SettingsError, match="only raster tiles are drawn"):
        TileFile(write_tiles(tmp_path / "city.pmtiles", TileType.MVT))


@pytest.mark.parametrize("content", [b"", b"PMTiles", b"x" * 1000])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "city.pmtiles"
    path.write_bytes(content)
    with pytest.raises(SettingsError, match="no PMTiles file"):
        TileFile(path)
    with pytest.raises(SettingsError, match="cannot be read"):
        TileFile(tmp_path / "none.pmtiles")
