"""The numerical core and the jobs that run it."""
