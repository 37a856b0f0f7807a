"""Campaigns repeated thousands of times (`python -m studies validate`): what is an interval worth.

It is judged by repeating the whole campaign, never by itself. Everything random is drawn anew for each replication, the
pool of cut-ins included. The truth is known: exactly for Markov chains, from an independent enumeration for overtaking
in the twin. ``experiment`` is the file, ``populations`` the paths and truths, ``shells`` and ``weighted`` what is
repeated, ``judgement`` what that is worth, ``run`` all of it.
"""
