"""Every backend of the renderer."""
