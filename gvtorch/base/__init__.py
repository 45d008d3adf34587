"""What every other package builds on: records, checks, constants, the names of stages."""
