"""Where a hand can take hold of an object: attachments proposed from the shapes of its links."""
