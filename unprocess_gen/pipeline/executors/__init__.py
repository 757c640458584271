"""Run the shard tasks of a dataset: with joblib on one machine (`local`), or with Dask (`dask`)."""
