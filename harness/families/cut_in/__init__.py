"""The naturalistic driving environment: initial states, accelerations, cut-ins."""
