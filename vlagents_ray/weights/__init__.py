"""The trainable parameters of a policy by name: reading, checking and replacing them."""
