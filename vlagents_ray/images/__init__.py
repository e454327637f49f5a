"""Images: JPEG, PNG and MP4, and the codecs that a message may use."""
