"""Commands of ``armcal`` that this application adds."""
