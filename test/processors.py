"""The same code as on an older processor, for which compilers and libraries take other paths."""

from __future__ import annotations

import os
import subprocess
import sys

# numpy knows the same instructions by other names from version 2.4 on, and warns of those that it
# does not know.
_FEATURES = (
    "AVX2 FMA3 AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR "
    "X86_V3 X86_V4"
)
_OLDER = {
    "NUMBA_CPU_NAME": "haswell",
    "OPENBLAS_CORETYPE": "Nehalem",
    "NPY_DISABLE_CPU_FEATURES": _FEATURES,
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4",
}


def printed_on_two(code: str, *arguments: str) -> tuple[str, str]:
    """What Python code prints on this processor, and as on an older one."""
    here, older = (
        subprocess.run(
            [sys.executable, "-c", code, *arguments],
            env=os.environ | environment,
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        for environment in ({}, _OLDER)
    )
    return here, older
