"""Golden runs: small campaigns whose records may not change in any bit while the code is moved about."""
