"""Positions on Earth: east, north and up of an origin on the WGS 84 ellipsoid, and their coordinate systems."""

from __future__ import annotations

from typing import Any

import numpy as np

from scanchain.data import Matrix, Points


class Geodesy:
    """A local frame: x east, y north, z up, at a latitude and longitude in degrees and an altitude in m."""

    def __init__(self, latitude: float, longitude: float, altitude_m: float) -> None:
        """Altitude above the ellipsoid."""
        from pyproj import Transformer  # takes 0.2 s

        self.origin = latitude, longitude, altitude_m
        at = f"+lat_0={latitude:.12f} +lon_0={longitude:.12f} +h_0={altitude_m:.6f}"
        topocentric = f"+step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 {at}"
        radians = "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad"
        self._to_enu = Transformer.from_pipeline(f"{radians} {topocentric}")

    def enu(self, positions: Matrix) -> Points:
        """(N, 3) east, north and up in m of latitudes and longitudes in degrees and altitudes in m (N, 3)."""
        latitude, longitude, altitude_m = positions.T
        return np.stack(self._to_enu.transform(longitude, latitude, altitude_m), axis=1)

    def geodetic(self, enu_m: Points) -> Matrix:
        """(N, 3) latitudes, longitudes and altitudes of points (N, 3)."""
        longitude, latitude, altitude_m = self._to_enu.transform(*enu_m.T, direction="INVERSE")
        return np.stack([latitude, longitude, altitude_m], axis=1)

    def projected(self, enu_m: Points) -> tuple[Points, Any]:
        """Easting, northing and altitude (N, 3) of points (N, 3) in the zone of UTM of the origin, and its CRS."""
        from pyproj import CRS, Transformer

        latitude, longitude, _ = self.origin
        zone = int((longitude + 180.0) // 6.0) % 60 + 1
        crs = CRS.from_epsg((32600 if latitude >= 0.0 else 32700) + zone)
        to_utm = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
        latitudes, longitudes, altitudes_m = self.geodetic(enu_m).T
        return np.stack([*to_utm.transform(longitudes, latitudes), altitudes_m], axis=1), crs
