"""Tables and figures of the SLPI and the MPI paper, reproduced on simulated and measured stages."""
