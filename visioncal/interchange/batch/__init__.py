"""Batch calibration of many sessions, on this machine or on a cluster."""

from visioncal.interchange.batch.run import Batch, Job, Options, batch, jobs_of
from visioncal.results.fleet import FleetRow

__all__ = ["Batch", "FleetRow", "Job", "Options", "batch", "jobs_of"]
