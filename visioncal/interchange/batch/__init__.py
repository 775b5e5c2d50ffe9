"""Batch calibration of many sessions, on this machine or on a cluster."""

from visioncal.interchange.batch.run import Batch, batch
from visioncal.interchange.batch.work import Job, Options, jobs_of
from visioncal.results.fleet import FleetRow

__all__ = ["Batch", "FleetRow", "Job", "Options", "batch", "jobs_of"]
