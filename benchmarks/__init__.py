"""armcal against its peers, measured in one run: ``python -m benchmarks``."""

import os

# One BLAS thread for everybody, as the armcal command has it; before numpy is imported.
for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"
