"""The report of a drive: one file that opens in any browser, offline."""
