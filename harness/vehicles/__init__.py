"""Longitudinal driver models and kinematics, shared by AVs, surrogates, SUMO world and twin."""
