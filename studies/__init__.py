"""Studies of methods, beside the package: what a tester of a vehicle does not need. Nothing in `harness` leads here.

``chains`` are exact worlds, ``replication`` repeats whole campaigns to see what intervals are worth, ``rnot`` follows
the procedure by which the paper compares methods, and ``case_study`` repeats its study. `python -m studies --help`.
"""
