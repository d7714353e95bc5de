"""The files of a map, all in one folder."""

from __future__ import annotations

from pathlib import Path

from sonarrec.files.outputs import writing
from sonarrec.mapping.build import SiteMap
from sonarrec.mapping.factors import factors, graph_of, write_factors, write_g2o
from sonarrec.mapping.picture import draw_map
from sonarrec.mapping.tables import Origin, write_geojson, write_map, write_passes


def write_all(folder: Path, site: SiteMap, origin: Origin | None = None) -> list[Path]:
    """Write map.csv, passes.csv, factors.csv, graph.g2o, map.png and, with an origin, map.geojson.

    Returns them. Raises SonarrecError where the folder cannot be written.
    """
    found = factors(site)
    graph = graph_of(site, found)
    paths = {name: folder / name for name in ("map.csv", "passes.csv", "factors.csv", "graph.g2o")}
    picture, earth = folder / "map.png", folder / "map.geojson"
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_map(paths["map.csv"], site)
        write_passes(paths["passes.csv"], site)
        write_factors(paths["factors.csv"], site, found, graph)
        write_g2o(paths["graph.g2o"], site, found, graph)
        draw_map(picture, site)
        earth.unlink(missing_ok=True)  # of a map before, with an origin
        if origin is not None:
            write_geojson(earth, site, origin)
    return [*paths.values(), picture, *([earth] if origin else [])]
