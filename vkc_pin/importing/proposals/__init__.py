"""Proposes attachments for the joints of an object."""
