"""Processes that run attempts of jobs: worker, runner, heartbeat, supervisor."""
