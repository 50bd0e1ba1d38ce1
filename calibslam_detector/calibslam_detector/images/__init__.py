"""Images in, pictures for a person out."""
