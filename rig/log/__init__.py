"""The experiment log: schema, writer, reader, dataset."""
