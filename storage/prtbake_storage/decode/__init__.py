"""Plain-numpy decoders of PRT assets, shared by SDK, previews and tests."""
