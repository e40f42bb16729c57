"""An atlas: many sheets as one thing, in a folder or in object storage."""
