"""A design held against the scans: elements and their statuses, and where its frame lies in theirs."""
