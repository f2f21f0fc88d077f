"""The artefact files: schema, reader, writer."""
