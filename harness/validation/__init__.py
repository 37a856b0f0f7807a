"""Replication experiments: what an interval is worth is judged by repeating the whole campaign, never by itself.

Everything random is drawn anew for each replication, the pool of cut-ins included. The truth is known: exactly for
Markov chains, from an independent enumeration for overtaking in the twin.
"""

from harness.validation.run import ValidationResult, validate

__all__ = ["ValidationResult", "validate"]
