"""The REST API under /v1: thin routes over the library, the job store and the queue."""
