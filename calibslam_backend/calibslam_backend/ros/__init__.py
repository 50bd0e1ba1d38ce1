"""Parts of the node `backend`: conversions, publishers, services, diagnostics."""
