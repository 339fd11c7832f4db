"""Import tables of one's own: CSV and Parquet files whose columns a map assigns to the fields of the wire contract."""
