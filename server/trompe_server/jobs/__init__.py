"""Jobs: their record, the engine that runs them, the worker process and what looks after it."""
