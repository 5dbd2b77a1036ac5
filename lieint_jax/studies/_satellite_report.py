def text(found):
    return ""
