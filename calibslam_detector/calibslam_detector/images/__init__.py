"""Images in, from messages and data sets; pictures for a person out."""
