"""Batch calibration of many sessions, on this machine or on a cluster."""

from visioncal.interchange.batch.run import Batch, Job, Options, Row, batch, jobs_of
