"""The plant behind the vendor's wire protocol, in wall-clock time."""
