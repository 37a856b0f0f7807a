"""What a run leaves: Arrow schemas, atomic Parquet writing, reading in index order."""
