"""SUMO: the only importer of libsumo and traci."""
