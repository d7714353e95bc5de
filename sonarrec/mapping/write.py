"""The files of a map, all in one folder."""

from __future__ import annotations

from pathlib import Path

from sonarrec.files.outputs import (
    check_no_recording,
    check_output,
    check_tables,
    is_filled,
    writing,
)
from sonarrec.mapping.build import SiteMap
from sonarrec.mapping.factors import FACTOR_COLUMNS, factors, graph_of, write_factors, write_g2o
from sonarrec.mapping.picture import draw_map
from sonarrec.mapping.tables import (
    GEOJSON_BEGIN,
    MAP_COLUMNS,
    PASS_COLUMNS,
    GeographicOrigin,
    write_geojson,
    write_map,
    write_passes,
)


def write_all(folder: Path, site: SiteMap, origin: GeographicOrigin | None = None) -> list[Path]:
    """Write map.csv, passes.csv, factors.csv, graph.g2o, map.png and, with an origin, map.geojson.

    Returns them. Raises SonarrecError where the folder cannot be written, UsageError, before
    anything is, where a file of another kind is there.
    """
    measurements = factors(site)
    graph = graph_of(site, measurements)
    headers = {"map.csv": MAP_COLUMNS, "passes.csv": PASS_COLUMNS, "factors.csv": FACTOR_COLUMNS}
    tables = [folder / name for name in headers]
    g2o, picture, earth = (folder / name for name in ("graph.g2o", "map.png", "map.geojson"))
    check_tables(folder, headers)
    if not is_filled(tables[0]):  # beside it the others are of a map as well, marked or not
        check_output(g2o, "graph")
        check_output(picture, "picture")
        check_output(earth, "JSON", header=GEOJSON_BEGIN)
    check_no_recording(folder, headers)
    with writing(folder):
        write_map(tables[0], site)
        write_passes(tables[1], site)
        write_factors(tables[2], site, measurements, graph)
        write_g2o(g2o, site, measurements, graph)
        draw_map(picture, site)
        earth.unlink(missing_ok=True)  # of a map before, with an origin
        if origin is not None:
            write_geojson(earth, site, origin)
    return [*tables, g2o, picture, *([earth] if origin else [])]
