"""What a plugin must keep to, as checks: ``assert_contract`` in a plugin's own tests, or ``armcal plugins check``."""

from armcal.testing.contract import assert_contract

__all__ = ["assert_contract"]
