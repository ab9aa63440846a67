"""Results of a run as files for other programs: NetCDF, CSV, NPZ, Parquet, VTK."""

from dvax.app.runs.export.export import FORMATS, export_run

__all__ = ["FORMATS", "export_run"]
