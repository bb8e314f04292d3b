"""Seeds of simulated worlds: options are chosen on the first, figures reported on the second."""

TUNING = (0, 1, 2, 3, 4)
REPORTING = (100, 101, 102, 103, 104)
