"""Write the page that describes a dataset."""
