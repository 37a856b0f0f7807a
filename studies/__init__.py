"""Studies of methods, beside the package: what a tester of a vehicle does not need. Nothing in `harness` leads here.

``run`` repeats campaigns (`python -m studies validate`): what an interval is worth is judged by repeating the whole
campaign, never by itself. Everything random is drawn anew for each replication, the pool of cut-ins included. The truth
is known: exactly for Markov chains, from an independent enumeration for overtaking in the twin. ``subjects`` says what
is repeated, ``shell_campaign`` and ``weighted_campaign`` how, ``judgement`` what that is worth. ``required_tests``
follows the procedure by which the paper compares methods (`python -m studies rnot`), ``case_study`` repeats its study.
"""
