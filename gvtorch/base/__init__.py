"""What every room stands on: records, checks, constants, the names of stages."""
