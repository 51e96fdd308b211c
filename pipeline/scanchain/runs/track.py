"""The path of a run on Earth, as GeoJSON and KML."""

from __future__ import annotations

import json
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from scanchain.data import Trajectory
from scanchain.files import write_whole
from scanchain.georeference import Georeference


def write_track(folder: Path, name: str, path: Trajectory, georeference: Georeference) -> None:
    """Write track.geojson (RFC 7946) and track.kml with the positions of a path along east, north and up."""
    latitudes, longitudes, altitudes_m = georeference.geodesy.geodetic(path.positions).T
    line = np.column_stack([longitudes.round(9), latitudes.round(9), altitudes_m.round(3)]).tolist()
    geometry = {"type": "LineString", "coordinates": line}
    track = {"type": "Feature", "properties": {"name": name}, "geometry": geometry}
    write_whole(folder / "track.geojson", json.dumps(track).encode() + b"\n")
    words = " ".join(",".join(map(repr, point)) for point in line)
    shape = f"<LineString><altitudeMode>absolute</altitudeMode><coordinates>{words}</coordinates></LineString>"
    placemark = f"<Placemark><name>{escape(name)}</name>{shape}</Placemark>"
    text = (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2">{placemark}</kml>\n'
    )
    write_whole(folder / "track.kml", text.encode())
