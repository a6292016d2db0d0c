"""Posed frames: read, carried to a device, and what is found out about their pixels."""
