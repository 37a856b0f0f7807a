"""What simulates the vehicles: SUMO in batches, or its twin in compiled code; the only importer of libsumo."""
