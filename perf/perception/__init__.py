"""Networks and decodings by themselves: what they find, on rendered and on real frames."""
