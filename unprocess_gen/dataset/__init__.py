"""Write and read the files of a dataset: shards, manifest, dataset.json."""
