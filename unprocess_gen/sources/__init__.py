"""List, read and decode source images."""
