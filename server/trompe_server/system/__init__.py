"""The operating system: files, processes with limits, memory, threads, logging."""
