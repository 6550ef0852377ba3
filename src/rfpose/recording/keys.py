"""Every name that appears inside an rfpose-iq file; see ``docs/recording-format.md``."""

from __future__ import annotations

from typing import Final

FORMAT_NAME: Final = "rfpose-iq"
FORMAT_VERSION: Final = 1

# attributes of the root group
FORMAT: Final = "format"
VERSION: Final = "format_version"
RATE_NUMERATOR: Final = "sample_rate_numerator"
RATE_DENOMINATOR: Final = "sample_rate_denominator"
CENTRE_FREQUENCY: Final = "centre_frequency_hz"
SAMPLE_FORMAT: Final = "sample_format"
FULL_SCALE: Final = "full_scale"
CREATED_BY: Final = "created_by"

# groups and datasets
PROVENANCE: Final = "provenance"
RECEIVERS: Final = "receivers"
IQ: Final = "iq"
BLOCKS: Final = "blocks"
SCENARIO: Final = "scenario"
TRUTH: Final = "truth"

# fields of the compound type of ``iq``, as Digital RF names them
REAL: Final = "r"
IMAG: Final = "i"
