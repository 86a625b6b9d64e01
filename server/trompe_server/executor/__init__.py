"""Who runs attempts of jobs where: the dispatcher over the port ``Executor``, on this machine or on a Ray cluster."""
